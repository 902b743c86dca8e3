"""Watching the star while motors are moved by hand-sized steps: no supervisor, no loop closed by the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps.motors import Motors, Servo
from fitctl.config import Range
from fitctl.controllers.centroid import Star, StarSensor
from fitctl.drivers.interface import CameraDriver, Frame
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
ANY_FLUX = Range(low=1e-6, high=1e9)
_FRAMES = 40  # averages the air
_LEAST_FRAMES = 0.6  # of these must show the star
_A_STAR = 0.5  # of the brightest spot's light
_STRAY_PX = 6.0  # from where the star is expected, another one's begins
_STILL_PX = 0.7
_LIKE = 1.4  # between the light of two spots that may be the same one
_BESIDE_PX = 2.0  # from where a spot is expected beside its star
_ASIDE = 1.3  # of the way to a star beyond the edge, whose direction is not known


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
        self._servo = None if motors is None else Servo(site, motors)
        self._several = len(site.rig.stellar_loops) > 1
        self._expected_px: Floats | None = None
        self._px_per_rad = np.zeros((2, 2))

    def follow(self, place_px: Floats, px_per_rad: Floats | None = None) -> None:
        """Where the frame has several loops' stars: which is ours, and how it moves with the motors."""
        if self._several:
            self._expected_px = np.array(place_px, dtype=float)
        if px_per_rad is not None:
            self._px_per_rad = px_per_rad

    def places_px(self, frames: int = _FRAMES) -> list[Floats]:
        """Where all stars are on average, the brightest first; where there is one loop, its own alone."""
        if not self._several:
            return [self.place_px(frames)]
        each = [
            [spot for spot in spots if spot.flux_dn > _A_STAR * max(s.flux_dn for s in spots)]
            for spots in self._spots(frames)
        ]
        first = max(each, key=len)
        found = []
        for star in sorted(first, key=lambda spot: -spot.flux_dn):
            near = [
                spot.position_px
                for spots in each
                for spot in spots
                if _apart_px(spot.position_px, star.position_px) < _STRAY_PX / 2
            ]
            found.append(np.asarray(np.median(near, axis=0)))
        return found

    def brightest(self, frames: int = 5, still: Sequence[Star] = ()) -> Star | None:
        """The brightest spot on the next frames, apart from the spots that stand still."""
        found = [
            star
            for spots in self._spots(frames)
            for star in spots
            if not any(_apart_px(star.position_px, one.position_px) < _STRAY_PX for one in still)
        ]
        return max(found, key=lambda star: star.flux_dn, default=None)

    def beside(self, star: Star, frames: int = 3) -> float:
        """How far from its star a spot must be that is none itself; 0 if it may be the star.

        Such a spot, as the rig file has it in `other_spots`, has that spot's light and no such spot beside it.
        """
        loop = self._site.loop
        low_dn, high_dn = loop.flux_range_dn
        if low_dn <= star.flux_dn <= high_dn:
            return 0.0
        each = self._spots(frames)
        for other in loop.other_spots:
            apart_px = math.hypot(other.offset_px.az, other.offset_px.el)
            like = 1 / _LIKE < star.flux_dn / other.flux_dn < _LIKE
            if like and not any(
                one.flux_dn < _A_STAR * star.flux_dn
                and abs(_apart_px(one.position_px, star.position_px) - apart_px) < _BESIDE_PX
                for spots in each
                for one in spots
            ):
                return apart_px
        return 0.0

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
        chosen = [self._ours(spots) for spots in self._spots(frames)]
        places = [star.position_px for star in chosen if star is not None]
        if len(places) < _LEAST_FRAMES * frames:
            msg = (
                f"the star is on {len(places)} of {frames} frames: it has left the field; "
                "bring it to the middle "
                "and repeat the step"
            )
            raise StepError(msg)
        return np.asarray(np.median(places, axis=0))

    def _ours(self, spots: list[Star]) -> Star | None:
        if self._expected_px is None:
            return max(spots, key=lambda star: star.flux_dn, default=None)
        expected_px = self._expected_px
        stars = [one for one in spots if one.flux_dn > _A_STAR * max(s.flux_dn for s in spots)]
        near = [one for one in stars if _apart_px(one.position_px, expected_px) < _STRAY_PX]
        return min(near, key=lambda one: _apart_px(one.position_px, expected_px), default=None)

    def turn_to(self, goal_rad: Floats) -> None:
        """Turn both motors to an angle of their encoders, slowly.

        Raises
        ------
        StepError
            As :meth:`fitctl.commissioning.steps.motors.Servo.turn_to`; or the motors have no power.
        """
        if self._servo is None:
            msg = "the motors have no power"
            raise StepError(msg)
        if self._expected_px is not None:
            self._expected_px = self._expected_px + self._px_per_rad @ (goal_rad - self.goal_rad)
        self._servo.turn_to(goal_rad)

    @property
    def goal_rad(self) -> Floats:
        """Where the motors were last sent."""
        return np.zeros(2) if self._servo is None else self._servo.goal_rad

    def _hold(self) -> None:
        if self._servo is not None:
            self._servo.hold()

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


def _apart_px(one: Floats, other: Floats) -> float:
    return float(np.linalg.norm(np.asarray(one) - other))


def displaced(before: list[Floats], after: list[Floats]) -> tuple[Floats, Floats] | None:
    """Where the one star was and is that has moved; None where none has, or not one alone."""
    gone = [one for one in before if not any(_apart_px(one, b) < _STILL_PX for b in after)]
    come = [one for one in after if not any(_apart_px(one, a) < _STILL_PX for a in before)]
    return (gone[0], come[0]) if len(gone) == len(come) == 1 else None


def search_extent(site: Site) -> tuple[float, int]:
    """Between two looks of a search, motor angle in radians; and how many of these it goes each way at most."""
    scale = scales(site.rig, site.loop)
    camera = site.rig.camera
    step_rad = 0.6 * min(camera.width_px, camera.height_px) / scale.motor_px_per_rad
    reach_px = site.loop.acquisition.search_radius_sky_arcsec / scale.sky_arcsec_per_px
    return step_rad, math.ceil(reach_px / scale.motor_px_per_rad / step_rad)


def search(site: Site, watch: Watch, others: list[Star] | None = None) -> tuple[Star, int]:
    """The brightest spot, on the frame or on a square spiral about it; and after how many looks.

    The spiral is in the motors' own angles, so that it needs neither rotation nor sign of the siderostat.
    A spot that was among `others` and has not moved is not taken: it is another loop's star.

    Raises
    ------
    StepError
        If there is none.
    """
    still = others or []
    star = watch.brightest()
    if star is not None and not still:
        return to_the_star(site, watch, star, still), 0
    step_rad, turns = search_extent(site)
    centre_rad = watch.goal_rad.copy()
    for looks, (right, up) in enumerate(square_spiral(turns), start=1):
        site.report(f"look {looks}: az {right * step_rad:+.1f}, el {up * step_rad:+.1f} rad")
        watch.turn_to(centre_rad + step_rad * np.array([right, up]))
        star = watch.brightest(3, still)
        if star is not None:
            return to_the_star(site, watch, star, still), looks
    watch.turn_to(centre_rad)
    msg = (
        f"no star within {turns * step_rad:.1f} rad of the motors about the start; check "
        "shutter, lamp, exposure and "
        "alignment, or turn the siderostat to the star by hand"
    )
    if still:
        msg += (
            f". What is on the camera does not move with {site.name}'s motors: check whether its amplifiers "
            "are those of another loop"
        )
    raise StepError(
        msg, {} if watch.motors is None else {"furthest_rad": watch.motors.furthest_rad}
    )


def to_the_star(site: Site, watch: Watch, star: Star, still: Sequence[Star] = ()) -> Star:
    """The star that a spot belongs to, brought onto the frame if only its other spot was there.

    Where nothing brighter comes onto the frame, the motors go back: the spot is the star itself, and dim.
    """
    apart_px = watch.beside(star)
    if not apart_px:
        return star
    site.report("the spot has the light of a spot beside the star: looking for the star around it")
    aside_rad = _ASIDE * apart_px / scales(site.rig, site.loop).motor_px_per_rad
    centre_rad = watch.goal_rad.copy()
    for right, up in square_spiral(1):
        watch.turn_to(centre_rad + aside_rad * np.array([right, up]) / math.hypot(right, up))
        brighter = watch.brightest(3, still)
        if brighter is not None and _A_STAR * brighter.flux_dn > star.flux_dn:
            return brighter
    watch.turn_to(centre_rad)
    return star


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
