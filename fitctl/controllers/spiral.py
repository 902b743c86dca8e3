"""Archimedean search spiral, in pixels of the focal plane.

With a usable field that holds a circle of radius h, the turns are sqrt(2) h (less the overlap) apart, so
that every star passes within h / sqrt(2) of the field's centre and stays in the circle over a chord of at
least sqrt(2) h. The speed puts the wanted number of frames into that chord.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, HALF_WINDOW_PX, Rig
from fitctl.controllers.photodiodes import capture_radius_m
from fitctl.model.compiled import compilable
from fitctl.model.optics import scales, sky_px_per_rad

_LOOKS_BEYOND_FOUND = 2  # frames in the chord beyond those that count a star as found


@dataclass(frozen=True, slots=True)
class SpiralPlan:
    """What a search will do.

    Attributes
    ----------
    pitch_px : float
        Distance between turns.
    speed_px_s : float
        Along the path.
    acceleration_px_s2 : float
        The path is slower near its middle, so as not to pass this.
    radius_px : float
        Where the search ends: half a turn's distance beyond the farthest star, or a star there could
        pass outside the last turn.
    field_radius_px : float
        Circle in which every star is detected.
    """

    pitch_px: float
    speed_px_s: float
    acceleration_px_s2: float
    radius_px: float
    field_radius_px: float

    @property
    def growth_px(self) -> float:
        """Radius gained in a radian."""
        return self.pitch_px / (2 * math.pi)

    @property
    def duration_s(self) -> float:
        """About how long it takes, but for its slower middle: the area over what is covered in a second."""
        return math.pi * self.radius_px**2 / (self.pitch_px * self.speed_px_s)


def plan_spiral(
    rig: Rig,
    loop_name: str,
    *,
    radius_sky_arcsec: float | None = None,
    field_overlap: float | None = None,
) -> SpiralPlan:
    """The spiral that misses no star within the search radius; this and the overlap are the rig's unless given.

    Its pitch follows from the field of view, its speed from the frame rate, the motors and the blur of
    a spot: not more than one window half in one exposure.
    """
    loop = rig.stellar_loops[loop_name]
    scale = scales(rig, loop)
    camera, acquisition = rig.camera, loop.acquisition
    # The 7x7 window must fit, and its centre may be half a pixel off the spot's.
    field_px = min(camera.width_px, camera.height_px) / 2 - HALF_WINDOW_PX - 1.0
    overlap = acquisition.field_overlap if field_overlap is None else field_overlap
    reach_px = field_px * (1 - overlap)
    looks = acquisition.found_frames + _LOOKS_BEYOND_FOUND
    speed_px_s = min(
        math.sqrt(2) * reach_px / looks * camera.frame_rate_hz,
        HALF_WINDOW_PX / camera.exposure_s,
        0.5 * loop.siderostat.velocity_limit_rad_s * scale.motor_px_per_rad,
    )
    pitch_px = math.sqrt(2) * reach_px
    if radius_sky_arcsec is None:
        radius_sky_arcsec = acquisition.search_radius_sky_arcsec
    return SpiralPlan(
        pitch_px=pitch_px,
        speed_px_s=speed_px_s,
        acceleration_px_s2=0.25
        * loop.siderostat.acceleration_limit_rad_s2
        * scale.motor_px_per_rad,
        radius_px=radius_sky_arcsec / scale.sky_arcsec_per_px + pitch_px / 2,
        field_radius_px=field_px,
    )


def plan_beam_spiral(
    rig: Rig, loop_name: str, *, radius_sky_arcsec: float | None = None
) -> SpiralPlan:
    """The spiral of a metrology loop's siderostat that misses no beam within the search radius.

    Its pitch follows from the radius in which the photodiodes capture the beam, which their noise gives. Beam
    angles are in the camera's pixels, as those of other loops.
    """
    loop = rig.metrology_loops[loop_name]
    acquisition, sensor = loop.acquisition, loop.sensor
    px_per_rad = sky_px_per_rad(rig)
    px_per_motor_rad = px_per_rad * loop.siderostat.sky_rad_per_motor_rad
    captured_m = capture_radius_m(sensor, acquisition.detection_sigma)
    capture_px = captured_m / sensor.link_length_m * px_per_rad
    reach_px = capture_px * (1 - acquisition.field_overlap)
    pitch_px = math.sqrt(2) * reach_px
    looks = acquisition.found_frames + _LOOKS_BEYOND_FOUND
    if radius_sky_arcsec is None:
        radius_sky_arcsec = acquisition.search_radius_sky_arcsec
    return SpiralPlan(
        pitch_px=pitch_px,
        speed_px_s=min(
            pitch_px / looks * rig.camera.frame_rate_hz,
            0.5 * loop.siderostat.velocity_limit_rad_s * px_per_motor_rad,
        ),
        acceleration_px_s2=0.25 * loop.siderostat.acceleration_limit_rad_s2 * px_per_motor_rad,
        radius_px=radius_sky_arcsec / ARCSEC_PER_RAD * px_per_rad + pitch_px / 2,
        field_radius_px=capture_px,
    )


@compilable()
def angular_rate(plan: Any, angle: float) -> float:
    """How fast a spiral turns at an angle from its middle, rad/s."""
    length_px_per_rad = plan.growth_px * math.sqrt(1 + angle**2)
    curvature_radius_px = plan.growth_px * (1 + angle**2) ** 1.5 / (2 + angle**2)
    acceleration_limit = math.sqrt(plan.acceleration_px_s2 * curvature_radius_px)
    return min(plan.speed_px_s, acceleration_limit) / length_px_per_rad


@compilable()
def spiral_angle_after(plan: Any, angle: float, duration_s: float) -> float:
    """The angle from the spiral's middle `duration_s` later."""
    # The speed is that at the step's end, where the path is longest for the angle.
    ahead = angle + angular_rate(plan, angle) * duration_s
    return angle + angular_rate(plan, ahead) * duration_s


class Spiral:
    """A walk along the spiral; it can wait, but not go back.

    Parameters
    ----------
    plan : SpiralPlan
    """

    def __init__(self, plan: SpiralPlan) -> None:
        self._plan = plan
        self._angle = 0.0

    @property
    def radius_px(self) -> float:
        """Distance from the middle."""
        return self._plan.growth_px * self._angle

    @property
    def exhausted(self) -> bool:
        """The search radius has been covered."""
        return self.radius_px >= self._plan.radius_px

    @property
    def progress(self) -> float:
        """Part of the searched area, 0 to 1."""
        return min(1.0, (self.radius_px / self._plan.radius_px) ** 2)

    def position_px(self) -> NDArray[np.float64]:
        """Where the search is, from its middle, shape (2,)."""
        return self.radius_px * np.array([math.cos(self._angle), math.sin(self._angle)])

    def advance(self, duration_s: float) -> NDArray[np.float64]:
        """Go on for `duration_s` and return the new position, shape (2,)."""
        self._angle = spiral_angle_after(self._plan, self._angle, duration_s)
        return self.position_px()
