"""What a tick is decided by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.centroid import Star
from fitctl.drivers.interface import Frame
from fitctl.stages.servo import ServoState


class Observation(NamedTuple):
    """One tick's view of star and stages.

    Attributes
    ----------
    frame : Frame or None
        The newest; None if none came in time.
    frames_lost, frames_skipped : int
        Since the camera was opened: frames that it lost, and frames that came while a newer one was there
        already, on which no tick acted.
    star : Star or None
        On the frame, if there is one and it shows the star.
    mirror_rad, motor_rad : arrays, shape (2,)
        Where the stages were at the frame's mid-exposure; without a frame, now.
    servo : ServoState
        How the servo is now.
    now_s : float
        When that is: the tick's beginning.
    link_rad : array, shape (2,), or None
        Motor angles that turn the star as far as the siderostat of the loop's link and the sky did; None
        without either.
    link_motor_rad : array, shape (2,), or None
        Angles of the motors of the link's siderostat at the same time as `motor_rad`; None without a link.
    sky_rad : array, shape (2,), or None
        Part of `link_rad` that is the sky's; None of a star that stands.
    backlash_rad : array, shape (2,), or None
        Part of `mirror_rad` that makes up for the siderostats' backlash, which is no part of the law's.
    """

    frame: Frame | None
    frames_lost: int
    frames_skipped: int
    star: Star | None
    mirror_rad: NDArray[np.float64]
    motor_rad: NDArray[np.float64]
    servo: ServoState
    now_s: float
    link_rad: NDArray[np.float64] | None = None
    link_motor_rad: NDArray[np.float64] | None = None
    sky_rad: NDArray[np.float64] | None = None
    backlash_rad: NDArray[np.float64] | None = None

    @property
    def law_mirror_rad(self) -> NDArray[np.float64]:
        """Where the mirror was by the control law alone, shape (2,)."""
        return self.mirror_rad if self.backlash_rad is None else self.mirror_rad - self.backlash_rad

    @property
    def beam_rad(self) -> NDArray[np.float64]:
        """Motor angles that turn the star as far as all siderostats and the sky did, shape (2,)."""
        return self.motor_rad if self.link_rad is None else self.motor_rad + self.link_rad
