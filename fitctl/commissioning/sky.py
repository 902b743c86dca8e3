"""Watching the star while motors are moved by hand-sized steps: no supervisor, no loop closed by the camera."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.motors import Motors
from fitctl.commissioning.outcome import Site, StepError
from fitctl.config import Range
from fitctl.controllers.centroid import Star, StarSensor
from fitctl.drivers.interface import CameraDriver, Frame
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
ANY_FLUX = Range(low=1e-6, high=1e9)
MOST_RAD_S = 4.0
_GAIN_PER_S = 15.0
_THERE_RAD = 0.01
_AWAY_RAD = 0.2
_FRAMES = 40  # averages the air
_LEAST_FRAMES = 0.6  # of these must show the star


class Watch:
    """A camera and the motors of one siderostat, used in turn by one thread.

    Parameters
    ----------
    site : Site
    camera : CameraDriver
        Its stream runs.
    motors : Motors, optional
        Powered. They are kept alive while frames are awaited.
    """

    def __init__(self, site: Site, camera: CameraDriver, motors: Motors | None) -> None:
        self._site, self._camera, self.motors = site, camera, motors
        loop = site.loop
        self._sensor = StarSensor(site.rig.camera, loop.model_copy(update={"flux_range": ANY_FLUX}))
        self.goal_rad = np.zeros(2)
        if motors is not None:
            motors.exchange((0.0, 0.0))
            self.goal_rad = np.array(motors.position_rad)
        self._sent_rad = self.goal_rad.copy()

    def brightest(self, frames: int = 5) -> Star | None:
        """The brightest spot of the next frames."""
        found = [star for spots in self._spots(frames) for star in spots]
        return max(found, key=lambda star: star.flux_dn, default=None)

    def spots(self, frames: int = 10) -> list[Star]:
        """All spots of one frame, brightest first: the frame that has most."""
        each = self._spots(frames)
        most = max(each, key=len)
        return sorted(most, key=lambda star: -star.flux_dn)

    def place_px(self, frames: int = _FRAMES) -> Floats:
        """Where the brightest spot is on average.

        Raises
        ------
        StepError
            If it is not on most frames.
        """
        places = [
            max(spots, key=lambda star: star.flux_dn).position_px
            for spots in self._spots(frames)
            if spots
        ]
        if len(places) < _LEAST_FRAMES * frames:
            msg = (
                f"the star is on {len(places)} of {frames} frames: it has left the field; "
                "bring it to the middle "
                "and repeat the step"
            )
            raise StepError(msg)
        return np.asarray(np.median(places, axis=0))

    def turn_to(self, goal_rad: Floats) -> None:
        """Turn both motors to an angle of their encoders, slowly.

        Raises
        ------
        StepError
            If one does not get there, or goes the other way, or the angle is beyond the travel.
        """
        if self.motors is None:
            msg = "the motors have no power"
            raise StepError(msg)
        self.goal_rad = np.array(goal_rad, dtype=float)
        travel_rad = self._site.loop.siderostat.travel_rad
        if np.max(np.abs(self.goal_rad)) > travel_rad:
            msg = (
                f"({goal_rad[0]:.1f}, {goal_rad[1]:.1f}) rad is beyond the travel of "
                f"{travel_rad:.1f} rad from the "
                "encoders' zero; bring the siderostat nearer to its middle"
            )
            raise StepError(msg)
        began_rad = np.array(self.motors.position_rad)
        way_rad = np.max(np.abs(self.goal_rad - began_rad))
        until_s = self._site.clock.now_s() + 2 * way_rad / MOST_RAD_S + 2.0
        while np.max(np.abs(self.goal_rad - self.motors.position_rad)) > _THERE_RAD:
            self._hold()
            apart_rad = np.max(np.abs(self.goal_rad - self.motors.position_rad))
            if apart_rad > way_rad + _AWAY_RAD:
                msg = "a motor goes away from where it is sent; repeat the step amplifiers"
                raise StepError(msg)
            if self._site.clock.now_s() > until_s:
                at = ", ".join(f"{one:.2f}" for one in self.motors.position_rad)
                msg = (
                    f"the motors are at ({at}) rad and were sent to "
                    f"({self.goal_rad[0]:.2f}, {self.goal_rad[1]:.2f}) rad: one does not "
                    "follow; check for a stop or "
                    "a limit of the amplifier"
                )
                raise StepError(msg)

    def _hold(self) -> None:
        if self.motors is None:
            return
        apart = self.goal_rad - self.motors.position_rad
        az, el = np.clip(_GAIN_PER_S * apart, -MOST_RAD_S, MOST_RAD_S).tolist()
        self.motors.exchange((az, el))

    def _spots(self, count: int) -> list[list[Star]]:
        """All spots of each of the next frames; the amplifiers hear from us also while frames are evaluated."""
        each = []
        for frame in self._frames(count):
            self._hold()
            each.append(list(self._sensor.candidates(frame.image)))
        return each

    def _frames(self, count: int) -> list[Frame]:
        """The next frames that are exposed from now on; motors are held meanwhile."""
        since_s = self._site.clock.now_s()
        until_s = since_s + 2 * count * self._site.rig.camera.period_s + 2.0
        frames: list[Frame] = []
        while len(frames) < count:
            self._hold()
            wait_s = 0.0 if self.motors is not None else 0.1
            frame = self._camera.next_frame(wait_s)
            if frame is not None and frame.mid_exposure_s > since_s:
                frames.append(frame._replace(image=frame.image.copy()))
            if self._site.clock.now_s() > until_s:
                msg = f"{len(frames)} of {count} frames came in time; check the camera's link"
                raise StepError(msg)
        return frames


def search(site: Site, watch: Watch) -> tuple[Star, int]:
    """The brightest spot, on the frame or on a square spiral about it; and after how many looks.

    The spiral is in the motors' own angles, so that it needs neither rotation nor sign of the siderostat.

    Raises
    ------
    StepError
        If there is none.
    """
    star = watch.brightest()
    if star is not None:
        return star, 0
    scale = scales(site.rig, site.loop)
    camera = site.rig.camera
    step_rad = 0.6 * min(camera.width_px, camera.height_px) / scale.motor_px_per_rad
    reach_px = site.loop.acquisition.search_radius_sky_arcsec / scale.sky_arcsec_per_px
    turns = math.ceil(reach_px / scale.motor_px_per_rad / step_rad)
    centre_rad = watch.goal_rad.copy()
    for looks, (right, up) in enumerate(square_spiral(turns), start=1):
        site.report(f"look {looks}: az {right * step_rad:+.1f}, el {up * step_rad:+.1f} rad")
        watch.turn_to(centre_rad + step_rad * np.array([right, up]))
        star = watch.brightest(3)
        if star is not None:
            return star, looks
    watch.turn_to(centre_rad)
    msg = (
        f"no star within {turns * step_rad:.1f} rad of the motors about the start; check "
        "shutter, lamp, exposure and "
        "alignment, or turn the siderostat to the star by hand"
    )
    raise StepError(msg)


def square_spiral(turns: int) -> list[tuple[int, int]]:
    """Places about the middle, each a neighbour of the one before; the middle is left out."""
    places = []
    az = el = 0
    for turn in range(1, turns + 1):
        path = [(1, 0)] + [(0, 1)] * (2 * turn - 1) + [(-1, 0)] * (2 * turn)
        path += [(0, -1)] * (2 * turn) + [(1, 0)] * (2 * turn)
        for right, up in path:
            az, el = az + right, el + up
            places.append((az, el))
    return places
