"""The model of a night's spectrum: the air path, the camera's noise and lines, as frames sample them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import AirPathModel
from fitctl.controllers.design.linear_loop.disturbance import line_px2_per_hz

Floats = NDArray[np.float64]
_ALIASES = (
    -1,
    0,
    1,
)  # of the frame rate: the air falls by the fourth power, so that others hardly count


class Air(NamedTuple):
    """Eq. 8 by what frames determine best: ``strength / (s² + damping s + stiffness)``.

    Attributes
    ----------
    strength : float
        k / b1, px/s² for noise of unit intensity: the fast motion, which control is about.
    damping : float
        b2 / b1, 1/s: where the fast pole is.
    stiffness : float
        1 / b1, 1/s²: with it, where the slow pole is. Minutes show it few times.
    """

    strength: float
    damping: float
    stiffness: float

    @property
    def model(self) -> AirPathModel:
        """As designs want it."""
        return AirPathModel(
            gain_px=self.strength / self.stiffness,
            b1_s2=1 / self.stiffness,
            b2_s=self.damping / self.stiffness,
        )


def air_of(model: AirPathModel) -> Air:
    """The same for a model."""
    return Air(model.gain_px / model.b1_s2, model.b2_s / model.b1_s2, 1 / model.b1_s2)


def air_px2_per_hz(air: Air, frequency_hz: Floats, period_s: float) -> Floats:
    """One-sided density of the air path on frames, shape as `frequency_hz`."""

    def continuous(at_hz: Floats) -> Floats:
        omega2 = (2 * math.pi * at_hz) ** 2
        return 2 * air.strength**2 / ((air.stiffness - omega2) ** 2 + air.damping**2 * omega2)

    return _sampled(continuous, frequency_hz, period_s)


def framed_line_px2_per_hz(
    own_hz: float, half_width_hz: Floats, frequency_hz: Floats, period_s: float
) -> Floats:
    """One-sided density on frames of a line of 1 px RMS.

    Parameters
    ----------
    own_hz : float
        Of the oscillator.
    half_width_hz : array
        At half power, with what the segments' length adds; shape as `frequency_hz`.
    """
    return _sampled(partial(line_px2_per_hz, own_hz, half_width_hz), frequency_hz, period_s)


def _sampled(
    continuous: Callable[[Floats], Floats], frequency_hz: Floats, period_s: float
) -> Floats:
    return np.asarray(sum(continuous(frequency_hz + alias / period_s) for alias in _ALIASES))


def white_px2_per_hz(noise_px: float, period_s: float) -> float:
    """One-sided density of a white sequence."""
    return 2 * period_s * noise_px**2
