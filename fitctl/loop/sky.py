"""A star that moves: how far it has come, and how much of that its siderostat has undone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import AxisPair
from fitctl.model.optics import Scales, star_rate_px_s

Floats = NDArray[np.float64]


class Sky:
    """Of one stellar loop's star, as :class:`fitctl.loop.link.Link` is of its light's way.

    Angles, shape (2,), are of the loop's motors: those that turn the star as far as it has moved since the
    clock's zero.

    Parameters
    ----------
    scale : Scales
    setpoint_period_s : float
        A set-point is where the motors are to be so much later.
    now_s : float
        It has not moved before.

    Attributes
    ----------
    turned_rad : array, shape (2,)
        How far it had moved at the last :meth:`read_at`.
    undone_rad : array, shape (2,)
        How much of that the siderostat has undone, or will have when its set-point is reached.
    """

    def __init__(self, scale: Scales, setpoint_period_s: float, now_s: float = 0.0) -> None:
        self._scale = scale
        self._period_s = setpoint_period_s
        self._rate_rad_s = np.zeros(2)
        self._read_s = self._since_s = now_s
        self._before_rad = np.zeros(2)
        self.turned_rad = np.zeros(2)
        self.undone_rad = np.zeros(2)

    def move_at(self, rate_sky_arcsec_s: AxisPair | None) -> None:
        """Since it was last read, the star moves at this rate, or stands."""
        self._since_s, self._before_rad = self._read_s, self.turned_rad
        self._rate_rad_s = sky_rad_s(rate_sky_arcsec_s, self._scale)

    def recall(self, time_s: float, turned_rad: Floats, rate_sky_arcsec_s: AxisPair | None) -> None:
        """By a time, shape (2,), it had moved so far, and it goes on at this rate."""
        self._read_s, self.turned_rad = time_s, turned_rad
        self.move_at(rate_sky_arcsec_s)

    def read_at(self, time_s: float) -> None:
        """Where the star is at a time."""
        self._read_s, self.turned_rad = time_s, self.turned_at(time_s)

    def turned_at(self, time_s: float) -> Floats:
        """How far the star has moved by a time, shape (2,)."""
        return self._before_rad + self._rate_rad_s * (time_s - self._since_s)

    def begin(self, now_s: float) -> None:
        """Nothing is to be undone of what it has moved so far."""
        self.undone_rad = self.turned_at(now_s + self._period_s)

    def step_rad(self, now_s: float) -> Floats:
        """By how much the set-point is to move now, so that the star stays where it is on the camera."""
        before_rad = self.undone_rad
        self.begin(now_s)
        return before_rad - self.undone_rad


def sky_rad_s(rate_sky_arcsec_s: AxisPair | None, scale: Scales) -> Floats:
    """Rate of the motors that turns the star as fast as it moves by itself, shape (2,)."""
    return scale.motor_rad(star_rate_px_s(rate_sky_arcsec_s, scale))
