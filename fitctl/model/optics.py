"""Optics and geometry: from motors and stacks to pixels, Eq. 1-5 and Table 1 of the FIT paper.

Angles are small. ``az`` is along the camera's x (columns), ``el`` along y (rows); arrays keep the pair
on their last axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, AxisPair, Loop, Rig
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scales:
    """How far one unit of each stage moves the star on the focal plane, and which way.

    A stage's axes may be turned from the camera's: what is in radians, or on the sky, is along the stage's;
    what is in pixels, along the camera's.

    Attributes
    ----------
    sky_px_per_rad : float
        Beam angle on the sky, before the compressor, to focal plane: k_comp f_i / pixel.
    motor_px_per_rad : float
        Siderostat motor to focal plane: 1.437e-4 m/rad on FIT.
    mirror_px_per_rad : float
        Fast steering mirror to focal plane: k_FSM f_i / pixel.
    siderostat_turn, mirror_turn : arrays, shape (2, 2)
        From each stage's axes to the camera's: its rotation, and what its axes have of different gains; the
        identity where they agree.
    siderostat_back, mirror_back : arrays, shape (2, 2)
        Their inverses.
    sky_turn : array, shape (2, 2)
        Rotation of the siderostat's axes to the camera's.
    pixel_size_m : float
        One pixel.
    """

    sky_px_per_rad: float
    motor_px_per_rad: float
    mirror_px_per_rad: float
    siderostat_turn: Floats
    mirror_turn: Floats
    siderostat_back: Floats
    mirror_back: Floats
    sky_turn: Floats
    pixel_size_m: float

    @property
    def sky_arcsec_per_px(self) -> float:
        """Beam angle on the sky of one pixel."""
        return ARCSEC_PER_RAD / self.sky_px_per_rad

    # All of these take and give shape (..., 2).

    def motor_px(self, motor_rad: Floats) -> Floats:
        """How far motor angles move the star."""
        return self.motor_px_per_rad * motor_rad.dot(self.siderostat_turn.T)

    def motor_rad(self, star_px: Floats) -> Floats:
        """Motor angles that move the star so far."""
        return star_px.dot(self.siderostat_back.T) / self.motor_px_per_rad

    def mirror_px(self, mirror_rad: Floats) -> Floats:
        """How far mirror angles move the star."""
        return self.mirror_px_per_rad * mirror_rad.dot(self.mirror_turn.T)

    def sky_px(self, sky_arcsec: Floats) -> Floats:
        """An angle on the sky, along the siderostat's axes, on the focal plane."""
        return sky_arcsec.dot(self.sky_turn.T) / self.sky_arcsec_per_px

    def sky_arcsec(self, star_px: Floats) -> Floats:
        """What is so far on the focal plane, as an angle on the sky along the siderostat's axes."""
        return star_px.dot(self.sky_turn) * self.sky_arcsec_per_px


def scales(rig: Rig, loop: Loop) -> Scales:
    """Scales of one loop of a rig (Table 1)."""
    pixel_size_m = rig.camera.pixel_size_m
    siderostat = loop.siderostat
    px_per_rad = sky_px_per_rad(rig)
    siderostat_turn = stage_turn(siderostat.rotation_deg, siderostat.axis_gains)
    mirror_turn = stage_turn(loop.fsm.rotation_deg, loop.fsm.axis_gains)
    return Scales(
        sky_px_per_rad=px_per_rad,
        motor_px_per_rad=siderostat.sky_rad_per_motor_rad * px_per_rad,
        mirror_px_per_rad=loop.fsm.beam_per_mirror * rig.optics.focal_length_m / pixel_size_m,
        siderostat_turn=siderostat_turn,
        mirror_turn=mirror_turn,
        siderostat_back=_back(siderostat_turn, siderostat.axis_gains),
        mirror_back=_back(mirror_turn, loop.fsm.axis_gains),
        sky_turn=rotation(siderostat.rotation_deg),
        pixel_size_m=pixel_size_m,
    )


def stage_turn(rotation_deg: float, axis_gains: list[list[float]] | None) -> Floats:
    """From a stage's axes to the camera's, shape (2, 2)."""
    turn = rotation(rotation_deg)
    return turn if axis_gains is None else turn @ np.array(axis_gains)


def _back(turn: Floats, axis_gains: list[list[float]] | None) -> Floats:
    """From the camera's axes to a stage's; exact where it is a rotation."""
    return turn.T if axis_gains is None else np.asarray(np.linalg.inv(turn), float)


def star_rate_px_s(rate_sky_arcsec_s: AxisPair | None, scale: Scales) -> Floats:
    """How fast a star moves on the camera with the stages at rest, shape (2,); without a rate it stands."""
    if rate_sky_arcsec_s is None:
        return np.zeros(2)
    return scale.sky_px(np.array([rate_sky_arcsec_s.az, rate_sky_arcsec_s.el]))


def sky_px_per_rad(rig: Rig) -> float:
    """Beam angle on the sky, before the compressor, to focal plane."""
    return rig.optics.compressor_ratio * rig.optics.focal_length_m / rig.camera.pixel_size_m


def rotation(angle_deg: float) -> Floats:
    """The matrix, shape (2, 2), that turns from azimuth towards elevation."""
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[cos, -sin], [sin, cos]])


def gains_of(matrix: Floats, rotation_deg: float) -> list[list[float]]:
    """The `axis_gains`, row by row, that multiply with a stage's rotation to the matrix, shape (2, 2)."""
    gains = rotation(rotation_deg).T @ matrix
    return [[round(gain, 4) + 0.0 for gain in row] for row in gains.tolist()]  # 0.0, not -0.0


AzEl = tuple[float, float]
Rows = tuple[AzEl, AzEl]
"""A matrix of shape (2, 2), row by row, in plain floats: for one pair ten times as quick as an array."""


def rows(matrix: Floats) -> Rows:
    """A matrix of shape (2, 2) for :func:`transformed`."""
    (a, b), (c, d) = matrix.tolist()
    return (a, b), (c, d)


def transformed(matrix: Rows, az: float, el: float) -> AzEl:
    """A pair, by a matrix."""
    (a, b), (c, d) = matrix
    return a * az + b * el, c * az + d * el


@compilable(inline=True)
def turned(turn: Floats, az: float, el: float) -> tuple[float, float]:
    """A pair, by a matrix of shape (2, 2)."""
    return turn[0, 0] * az + turn[0, 1] * el, turn[1, 0] * az + turn[1, 1] * el


@compilable(inline=True)
def turned_back(turn: Floats, az: float, el: float) -> tuple[float, float]:
    """A pair, by the transpose of a matrix of shape (2, 2)."""
    return turn[0, 0] * az + turn[1, 0] * el, turn[0, 1] * az + turn[1, 1] * el


def stack_matrix(stack_radius_m: float) -> Floats:
    """S of Eq. 1, shape (3, 2): stack displacement in metres per radian of mirror."""
    return stack_radius_m * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def stack_volts(
    mirror_rad: Floats, stack_radius_m: float, stack_scale_m_per_v: float, bias_v: float
) -> Floats:
    """Eq. 1: D/A voltages, shape (..., 3), of wanted mirror angles, shape (..., 2)."""
    return mirror_rad @ stack_matrix(stack_radius_m).T / stack_scale_m_per_v + bias_v


def mirror_angles(
    volts: Floats, stack_radius_m: float, stack_scale_m_per_v: float, bias_v: float
) -> Floats:
    """Eq. 5: least-squares mirror angles, shape (..., 2), of D/A voltages, shape (..., 3)."""
    s = stack_matrix(stack_radius_m)
    return (volts - bias_v) * stack_scale_m_per_v @ np.linalg.solve(s.T @ s, s.T).T


def mirror_from_stacks(displacement_m: Floats, stack_radius_m: float) -> Floats:
    """Mirror angles, shape (..., 2), of three stack displacements about mid stroke, shape (..., 3).

    The plane through the three points of Eq. 2, for small angles; piston does not enter.
    """
    # Neighbours' differences are those of elevation, then azimuth.
    apart_m = displacement_m[..., :-1] - displacement_m[..., 1:]
    return apart_m[..., ::-1] / (2 * stack_radius_m)


def mirror_normal(displacement_m: Floats, stack_radius_m: float) -> Floats:
    """Eq. 3: unit normal, shape (..., 3), of the mirror on three displaced stacks, shape (..., 3)."""
    v1, v2, v3 = _stack_points(displacement_m, stack_radius_m)
    normal = np.cross(v3 - v2, v1 - v2)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def piston_m(displacement_m: Floats, stack_radius_m: float) -> Floats:
    """Eq. 4: distance along z from the origin to the mirror surface, shape (...)."""
    normal = mirror_normal(displacement_m, stack_radius_m)
    _, _, v3 = _stack_points(displacement_m, stack_radius_m)
    return np.sum(normal * v3, axis=-1) / normal[..., 2]


def _stack_points(displacement_m: Floats, r: float) -> tuple[Floats, Floats, Floats]:
    """Eq. 2: the three points where the stacks hold the mirror."""
    corners = np.array([[-r, r], [-r, -r], [r, -r]])
    points = np.empty((*displacement_m.shape, 3))
    points[..., :2] = corners
    points[..., 2] = displacement_m
    return points[..., 0, :], points[..., 1, :], points[..., 2, :]


def saturate_diamond(mirror_rad: Floats, range_rad: float) -> Floats:
    """Scale a pair of mirror angles, shape (2,), into |az| + |el| <= range, keeping its direction.

    Two axes share three stacks, so what can be reached is a diamond; clipping each axis by itself
    would overdrive a stack and turn the motion.
    """
    az_rad, el_rad = mirror_rad.tolist()
    reach_rad = abs(az_rad) + abs(el_rad)
    return mirror_rad if reach_rad <= range_rad else mirror_rad * (range_rad / reach_rad)
