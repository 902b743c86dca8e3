"""Volts of four photodiodes in a Gaussian beam."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import BeamSensor
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]


@compilable()
def light_v(sensor: Any, along_m: Any, squared_m2: Any) -> Any:
    """Volts that the light of the laser's nominal power gives a diode, or an array of diodes.

    Parameters
    ----------
    sensor : has diode_offset_m, on_axis_v and beam_radius_m
    along_m : float or array
        How far the beam's centre is from the array's towards the diode.
    squared_m2 : float or array
        The square of its whole distance from the array's.
    """
    # |p - r|^2 - d^2 of a diode at r, so that a beam on the centre gives on_axis_v.
    beyond_m2 = squared_m2 - 2.0 * sensor.diode_offset_m * along_m
    return sensor.on_axis_v * np.exp(-2.0 * beyond_m2 / sensor.beam_radius_m**2)


def diode_volts(sensor: BeamSensor, offset_m: ArrayLike, laser: ArrayLike = 1.0) -> Floats:
    """Volts without noise, shape (..., 4), in the order az+, az-, el+, el-.

    Parameters
    ----------
    sensor : BeamSensor
    offset_m : array_like, shape (..., 2)
        The centre of the beam from the centre of the array.
    laser : array_like
        Power of the laser over its nominal power; 0 is off.
    """
    offset_m = np.asarray(offset_m, dtype=float)
    along_m = np.empty((*offset_m.shape[:-1], 4))
    along_m[..., ::2], along_m[..., 1::2] = offset_m, -offset_m
    squared_m2 = offset_m[..., :1] ** 2 + offset_m[..., 1:] ** 2
    lit_v = light_v(sensor, along_m, squared_m2) * np.asarray(laser)[..., None]
    return np.asarray(lit_v + np.asarray(sensor.ambient_v))
