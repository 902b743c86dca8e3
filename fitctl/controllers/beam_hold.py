"""The control law that holds a metrology beam on the centre of its photodiodes.

An integrator of the siderostat's set-point, and a second, slower one. While the collector moves steadily, the
first alone leaves a standing error of its rate over the crossover; the second learns that rate and removes it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]


@compilable()
def pull_in_step(hold: Any, error: Any, duration_s: float) -> Any:
    """One step of the first integrator alone, for an error of one axis, or an array of both."""
    return -hold.gain_per_s * duration_s * error


@compilable()
def hold_step(hold: Any, rate: Any, error: Any, duration_s: float) -> Any:
    """One step of both integrators, likewise: the step, and the rate that the second has learnt by then."""
    pulled = pull_in_step(hold, error, duration_s)
    rate = rate + hold.second_per_s * pulled
    return pulled + rate * duration_s, rate


class BeamHold:
    """Both axes.

    Parameters
    ----------
    crossover_hz : float
        Of the first integrator.
    second_integrator_hz : float
        Below, the second works as well; 0 is none.

    Attributes
    ----------
    gain_per_s, second_per_s : float
        Of both integrators.
    rate_rad_s : array, shape (2,)
        How fast the beam is turned though it is on the centre: what the second integrator has learnt.
    """

    def __init__(self, crossover_hz: float, second_integrator_hz: float) -> None:
        self.gain_per_s = 2 * math.pi * crossover_hz
        self.second_per_s = 2 * math.pi * second_integrator_hz
        self.begin()

    def begin(self) -> None:
        """Nothing is known of the collector's motion."""
        self.rate_rad_s = np.zeros(2)

    def pull_in(self, error_rad: Floats, duration_s: float) -> Floats:
        """One step of the first integrator alone, for a beam that is far off; as :meth:`step`."""
        return np.asarray(pull_in_step(self, error_rad, duration_s))

    def step(self, error_rad: Floats | None, duration_s: float) -> Floats:
        """By how much to turn the beam, shape (2,).

        Parameters
        ----------
        error_rad : array, shape (2,), or None
            The beam's angle from the centre, by a sample that was not used before; None without one: the beam
            goes on at the learnt rate.
        duration_s : float
            Since the last step.
        """
        if error_rad is None:
            return self.rate_rad_s * duration_s
        step_rad, self.rate_rad_s = hold_step(self, self.rate_rad_s, error_rad, duration_s)
        return np.asarray(step_rad)
