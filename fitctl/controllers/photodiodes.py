"""Where the metrology beam falls on its four photodiodes.

The diodes stand at +-d on the two axes. A Gaussian beam of 1/e^2 radius w, centred at p, gives
``ln(i+ / i-) = 8 d p / w^2`` exactly, on each axis. So the estimate is linear
in p up to where the farther diode of a pair drowns in its noise; beyond, it is the least that p can be, which
still has the right direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]
Volts = tuple[float, float, float, float]
"""Of the diodes in the order az+, az-, el+, el-."""


class BeamState(IntEnum):
    """What one sample shows of the beam; logs have the number."""

    LOST = 0
    EDGE = 1
    MEASURED = 2
    SATURATED = 3


LOST, EDGE, MEASURED, SATURATED = map(int, BeamState)

MEANING = {
    BeamState.LOST: "no diode has more light than its noise may pretend",
    BeamState.EDGE: "a diode has light, but not both of each pair: direction and least distance",
    BeamState.MEASURED: "all four diodes have light: place and noise",
    BeamState.SATURATED: "a diode is at its limit: direction and least distance",
}


class Sensor(Protocol):
    """What is known of a photodiode array: the settings ``[loops.<name>.sensor]``."""

    @property
    def diode_offset_m(self) -> float:
        """From the centre to each diode, d."""
        ...

    @property
    def beam_radius_m(self) -> float:
        """1/e^2 radius of the beam at the array, w."""
        ...

    @property
    def on_axis_v(self) -> float:
        """Each diode's volts above ambient light, with the beam on the centre."""
        ...

    @property
    def noise_v(self) -> float:
        """One diode's noise in one sample, RMS."""
        ...

    @property
    def ambient_v(self) -> Sequence[float]:
        """Each diode's volts without the beam."""
        ...

    @property
    def saturated_v(self) -> float:
        """From here on, a reading gives only a lower bound of the light."""
        ...


class Beam(NamedTuple):
    """One sample.

    Attributes
    ----------
    state : BeamState
    az_m, el_m : float
        The beam from the array's centre; NaN if it is lost. Where it is not measured, the least distance.
    noise_az_m, noise_el_m : float
        Standard deviation of these; infinite along an axis on which neither diode has light.
    sum_v : float
        Of all four diodes, ambient light subtracted.
    """

    state: BeamState
    az_m: float
    el_m: float
    noise_az_m: float
    noise_el_m: float
    sum_v: float

    @property
    def place_m(self) -> Floats:
        """The beam from the array's centre, shape (2,)."""
        return np.array([self.az_m, self.el_m])


@compilable()
def beam_state(array: Any, brightest_v: float, dimmest_v: float, highest_v: float) -> int:
    """The number of the :class:`BeamState` of a sample.

    By the brightest and the dimmest diode's volts above ambient light, and the highest volts of any with it.
    """
    if brightest_v < array.threshold_v:
        return LOST
    if highest_v >= array.saturated_v:
        return SATURATED
    return EDGE if dimmest_v < array.threshold_v else MEASURED


@compilable()
def place_m(array: Any, plus_v: float, minus_v: float) -> float:
    """Place along one axis; a diode that is in the dark has the threshold's light at most."""
    threshold_v = array.threshold_v
    if plus_v < threshold_v > minus_v:
        return 0.0
    ratio = max(plus_v, threshold_v) / max(minus_v, threshold_v)
    return float(array.metres_per_log * math.log(ratio))


class PhotodiodeArray:
    """From volts to the beam's place.

    Parameters
    ----------
    sensor : Sensor
    detection_sigma : float
        How many times its noise a diode's reading must be to count as light.

    Attributes
    ----------
    threshold_v : float
        That, in volts.
    metres_per_log : float
        w^2 / (8 d): the beam's place for a ratio of e.
    saturated_v : float
        From here on a diode is at its limit.
    """

    def __init__(self, sensor: Sensor, detection_sigma: float) -> None:
        self.threshold_v = detection_sigma * sensor.noise_v
        self.metres_per_log = sensor.beam_radius_m**2 / (8.0 * sensor.diode_offset_m)
        self._ambient_v = tuple(sensor.ambient_v)
        self._noise_v = sensor.noise_v
        self.saturated_v = sensor.saturated_v

    def beam(self, volts: Volts) -> Beam:
        """What one sample says."""
        lights = [volt - dark for volt, dark in zip(volts, self._ambient_v, strict=True)]
        sum_v = sum(lights)
        state = BeamState(beam_state(self, max(lights), min(lights), max(volts)))
        if state is BeamState.LOST:
            return Beam(state, math.nan, math.nan, math.inf, math.inf, sum_v)
        az_plus_v, az_minus_v, el_plus_v, el_minus_v = lights
        return Beam(
            state,
            place_m(self, az_plus_v, az_minus_v),
            place_m(self, el_plus_v, el_minus_v),
            self._noise_m(az_plus_v, az_minus_v),
            self._noise_m(el_plus_v, el_minus_v),
            sum_v,
        )

    def _noise_m(self, plus_v: float, minus_v: float) -> float:
        """Of :func:`place_m`."""
        threshold_v = self.threshold_v
        if plus_v < threshold_v > minus_v:
            return math.inf
        plus_v, minus_v = max(plus_v, threshold_v), max(minus_v, threshold_v)
        noise = self._noise_v * math.hypot(1.0 / plus_v, 1.0 / minus_v)
        return self.metres_per_log * noise


def reach_m(sensor: Sensor, detection_sigma: float) -> float:
    """How far from a diode the beam's centre may be while the diode still has light beyond its noise."""
    threshold_v = detection_sigma * sensor.noise_v
    # Of a diode on which the beam is centred.
    brightest_v = sensor.on_axis_v * math.exp(
        2.0 * (sensor.diode_offset_m / sensor.beam_radius_m) ** 2
    )
    return sensor.beam_radius_m * math.sqrt(max(0.0, math.log(brightest_v / threshold_v)) / 2.0)


def capture_radius_m(sensor: Sensor, detection_sigma: float) -> float:
    """From the array's centre: a beam within it always gives light to a diode, whatever its direction.

    The worst direction is between two diodes.
    """
    aside_m = sensor.diode_offset_m / math.sqrt(2.0)
    reach = reach_m(sensor, detection_sigma)
    return aside_m + math.sqrt(reach**2 - aside_m**2) if reach > aside_m else 0.0


def ambient_of(samples_v: Floats) -> tuple[Floats, Floats]:
    """Ambient light of each diode and its standard error, shapes (4,), from samples without the beam.

    Parameters
    ----------
    samples_v : array, shape (n, 4)
        At least two.
    """
    samples_v = np.asarray(samples_v, dtype=float)
    error_v = samples_v.std(axis=0, ddof=1) / math.sqrt(len(samples_v))
    return samples_v.mean(axis=0), error_v
