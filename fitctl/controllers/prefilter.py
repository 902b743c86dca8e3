"""The filter on commanded beam angle: second order, critically damped, both axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable
from fitctl.model.optics import AzEl

Floats = NDArray[np.float64]


@compilable()
def filtered(
    command: float, value: float, rate: float, periods: float, decay: float
) -> tuple[float, float]:
    """Value and rate (in units of the time constant) of one axis a period later.

    `periods` is the period over the time constant, `decay` what that leaves of an exponential.
    """
    distance = value - command
    return (
        command + decay * ((1 + periods) * distance + periods * rate),
        decay * ((1 - periods) * rate - periods * distance),
    )


class Prefilter:
    """1 / (tau s + 1)^2, stepped exactly for a command that is constant over the period.

    Parameters
    ----------
    time_constant_s, period_s : float
    initial_px : array, shape (2,)

    Attributes
    ----------
    value_px : pair of float
        The filtered command.
    """

    def __init__(self, time_constant_s: float, period_s: float, initial_px: Floats) -> None:
        self.periods = period_s / time_constant_s
        self.decay = math.exp(-self.periods)
        self.reset(initial_px)

    def reset(self, value_px: Floats) -> None:
        """Rest at `value_px`, shape (2,)."""
        az_px, el_px = value_px.tolist()
        self.value_px: AzEl = az_px, el_px
        self._rates = (0.0, 0.0)

    def step(self, command_px: Floats) -> AzEl:
        """Go on by one period towards a command, shape (2,); returns the filtered one."""
        (az_px, el_px), (az_rate, el_rate) = self.value_px, self._rates
        to_az_px, to_el_px = command_px.tolist()
        periods, decay = self.periods, self.decay
        az_px, az_rate = filtered(to_az_px, az_px, az_rate, periods, decay)
        el_px, el_rate = filtered(to_el_px, el_px, el_rate, periods, decay)
        self.value_px, self._rates = (az_px, el_px), (az_rate, el_rate)
        return self.value_px
