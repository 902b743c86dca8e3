"""The model of a night's spectrum: the air path, the camera's noise and lines, as frames sample them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import AirPathModel
from fitctl.controllers.design.basis import Basis

Floats = NDArray[np.float64]


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


def framed_px2_per_hz(basis: Basis, frequency_hz: Floats) -> Floats:
    """One-sided density of a basis' air path and lines on frames, px²/Hz, shape as `frequency_hz`."""
    density = air_px2_per_hz(air_of(basis.air_path), frequency_hz, basis.period_s)
    for line in basis.lines:
        half_width_hz = np.full(len(frequency_hz), line.damping * line.frequency_hz)
        of_1_px = framed_line_slopes(
            line.frequency_hz, half_width_hz, frequency_hz, basis.period_s
        )[0]
        density = density + line.rms_px**2 * of_1_px
    return density


def air_px2_per_hz(air: Air, frequency_hz: Floats, period_s: float) -> Floats:
    """One-sided density of the air path on frames, shape as `frequency_hz`."""
    return air_slopes(air, frequency_hz, period_s)[0]


def air_slopes(air: Air, frequency_hz: Floats, period_s: float) -> tuple[Floats, Floats, Floats]:
    """As :func:`air_px2_per_hz`, and its derivatives by the logarithms of damping and stiffness."""
    return _oscillator(2 * air.strength**2, air.damping, air.stiffness, frequency_hz, period_s)


def framed_line_slopes(
    own_hz: float, half_width_hz: Floats, frequency_hz: Floats, period_s: float
) -> tuple[Floats, Floats, Floats]:
    """One-sided density on frames of a line of 1 px RMS, and its derivatives, 1/Hz each.

    Parameters
    ----------
    own_hz : float
        Of the oscillator; the first derivative is by it,
    half_width_hz : array
        and the second by this: at half power, with what the segments' length adds; shape as `frequency_hz`.
    """
    own, width = 2 * math.pi * own_hz, 4 * math.pi * half_width_hz
    total, by_damping, by_stiffness = _oscillator(
        4 * width * own**2, width, own**2, frequency_hz, period_s, round(own_hz * period_s)
    )
    # The power of a line of 1 px grows with its width and with the square of its frequency.
    return total, 2 * (total + by_stiffness) / own_hz, (total + by_damping) / half_width_hz


def _oscillator(
    power: float | Floats,
    damping: float | Floats,
    stiffness: float,
    frequency_hz: Floats,
    period_s: float,
    nearest: int = 0,
) -> tuple[Floats, Floats, Floats]:
    """``power / |s² + damping s + stiffness|²`` on frames; derivatives by logarithms of the last two.

    Counted are aliases beside the first multiple of the frame rate, and beside those about the nearest to it.
    """
    multiples = {-1, 0, 1}
    if nearest > 1:
        multiples |= {side * (nearest + beside) for side in (-1, 1) for beside in (-1, 0, 1)}
    rates = np.array(sorted(multiples), dtype=float)[:, None] / period_s
    omega2 = (2 * math.pi * (frequency_hz + rates)) ** 2
    away, broad = stiffness - omega2, damping**2 * omega2
    below = 1 / (away**2 + broad)
    density = power * below
    slope = -2 * below * density
    return density.sum(axis=0), (broad * slope).sum(axis=0), stiffness * (away * slope).sum(axis=0)


def seen_at_hz(frequency_hz: float, rate_hz: float) -> float:
    """Where frames of a rate show a vibration: at another frequency if it is faster than half the rate."""
    return abs(frequency_hz - round(frequency_hz / rate_hz) * rate_hz)


def white_px2_per_hz(noise_px: float, period_s: float) -> float:
    """One-sided density of a white sequence."""
    return 2 * period_s * noise_px**2
