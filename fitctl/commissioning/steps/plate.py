"""The star on the camera, and by how much and which way each stage moves it: scale, rotation, mirror images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.camera import streaming
from fitctl.commissioning.steps.motors import powered
from fitctl.commissioning.steps.sky import Watch, displaced, search, search_extent, to_the_star
from fitctl.config.wiring import STRAIGHT
from fitctl.controllers.centroid import Star
from fitctl.model.optics import gains_of, scales

Floats = NDArray[np.float64]
ROUGH_RAD = 0.35
FINE_RAD = 1.0
_TAKE_UP = 0.5  # of a step, before it: backlash
LEAST_PX = 0.7  # by a rough step
_NEAR_PX = 3.0
APART_PX = 7.0  # of two stars, to be told apart on the way
SCALE_APART = 0.08
ROTATION_APART_DEG = 5.0
EVEN = 1.15  # of the two singular values
_TWIN = 0.8  # of the brightest spot's light
_FLIPS = {
    "azimuth reversed": np.diag([-1.0, 1.0]),
    "elevation reversed": np.diag([1.0, -1.0]),
    "azimuth and elevation exchanged": np.array([[0.0, 1.0], [1.0, 0.0]]),
}
"""Ways in which motor angles may be another hand than the star's: each undoes itself."""


class Similar(NamedTuple):
    """A matrix as a scale, a rotation, and how uneven it is."""

    scale: float
    rotation_deg: float
    uneven: float


def similar(matrix: Floats) -> Similar:
    """The rotation and scale nearest to a matrix of positive determinant."""
    (a, b), (c, d) = matrix
    largest, least = np.linalg.svd(matrix, compute_uv=False)
    return Similar(
        math.sqrt(abs(float(np.linalg.det(matrix)))),
        math.degrees(math.atan2(c - b, a + d)),
        float(largest / max(least, 1e-12)),
    )


def turned_further(rotation_deg: float, by_deg: float) -> float:
    """The rig file's `rotation_deg`, corrected by a measured difference."""
    return round((rotation_deg + by_deg + 180) % 360 - 180, 1)


def uneven_line(off: Similar) -> str:
    """How the gains of a stage's axes differ from the expected ones, of which its response is off by `off`."""
    return (
        f"the ratio of the axes' gains differs from the rig file's by a factor of {off.uneven:.2f}"
    )


# ---------------------------------------------------------------- the star
def star_moves(site: Site) -> str:
    """What the step moves."""
    step_rad, turns = search_extent(site)
    if len(site.rig.stellar_loops) > 1:
        first = f"azimuth by {ROUGH_RAD:g} rad, to see which star it moves; if none"
    else:
        first = "nothing if the star is on the camera; otherwise"
    return f"{first} the motors, up to {turns * step_rad:.1f} rad each way"


def check_star(site: Site) -> Outcome:
    """Find the star, and compare its light with the rig file.

    Raises
    ------
    StepError
        If there is none, or more than one that could be it.
    """
    stars = len(site.rig.stellar_loops)
    with streaming(site) as camera:
        seen = Watch(site, camera, None)
        spots = seen.spots()
        moved_rad, looks = 0.0, 0
        at_px = spots[0].position_px if spots else np.zeros(2)
        if stars > 1 or not spots or seen.beside(spots[0]):
            with powered(site) as motors:
                watch = Watch(site, camera, motors)
                star, looks = own_star(site, watch, spots)
                spots, at_px = watch.spots(), star.position_px
                moved_rad = motors.furthest_rad
    if not spots:
        msg = "a spot appeared once and disappeared; repeat the step"
        raise StepError(msg)
    loop = site.loop
    flux_dn = _nearest(spots, at_px).flux_dn
    figures = {
        "flux_dn": flux_dn,
        "spots": float(len(spots)),
        "looks": float(looks),
        "furthest_rad": moved_rad,
    }
    lines = [
        f"spot at az {spot.az_px:.1f}, el {spot.el_px:.1f} px: {spot.flux_dn:.0f} DN"
        for spot in spots
    ]
    if _bright(spots) > stars:
        lights = " and ".join(f"{spot.flux_dn:.0f}" for spot in spots[: stars + 1])
        number = {2: "two", 3: "three"}.get(stars + 1, str(stars + 1))
        msg = f"{number} spots could be the star, of {lights} DN; cover the other star, and repeat the step"
        raise StepError(msg, figures)
    low_dn, high_dn = loop.flux_range_dn
    if low_dn <= flux_dn <= high_dn:
        return Outcome(lines, figures)
    part = flux_dn / loop.star_flux_dn
    other = [
        spot.model_dump() | {"flux_dn": round(spot.flux_dn * part, 1)} for spot in loop.other_spots
    ]
    lines.append(
        f"the star has {part:.2f} of star_flux_dn; the same factor is assumed for its other spots"
    )
    return Outcome(lines, figures, site.found(star_flux_dn=round(flux_dn, 1), other_spots=other))


def own_star(site: Site, watch: Watch, spots: list[Star]) -> tuple[Star, int]:
    """The loop's own star among the spots that were seen, or brought onto the frame after some looks.

    Raises
    ------
    StepError
        If there is none.
    """
    if len(site.rig.stellar_loops) == 1:
        return search(site, watch)
    moved_px = _moved_px(watch)
    if moved_px is None:
        return search(site, watch, spots)
    return to_the_star(site, watch, _nearest(watch.spots(), moved_px)), 0


def _moved_px(watch: Watch) -> Floats | None:
    """Where the one star is that moves with azimuth, which is back where it was afterwards."""
    start_rad = watch.goal_rad.copy()
    before = watch.places_px()
    watch.turn_to(start_rad + np.array([ROUGH_RAD, 0.0]))
    after = watch.places_px()
    watch.turn_to(start_rad)
    moved = displaced(before, after)
    return None if moved is None else moved[0]


def _nearest(spots: list[Star], place_px: Floats) -> Star:
    _first(spots)
    return min(spots, key=lambda spot: float(np.linalg.norm(spot.position_px - place_px)))


def _bright(spots: list[Star]) -> int:
    return sum(spot.flux_dn > _TWIN * spots[0].flux_dn for spot in spots)


# ---------------------------------------------------------------- the siderostat
def siderostat_moves(site: Site) -> str:
    """What the step moves."""
    px = scales(site.rig, site.loop).motor_px_per_rad
    most = (1 + _TAKE_UP) * FINE_RAD
    return (
        f"each motor by {ROUGH_RAD:g} rad, then both until the star is near its target, "
        f"then each by {most:g} rad "
        f"both ways: {most * px:.0f} px of the star"
    )


def check_siderostat(site: Site) -> Outcome:
    """How the star moves with the motors.

    Raises
    ------
    StepError
        If it does not, or leaves the field.
    """
    scale = scales(site.rig, site.loop)
    target_px = np.array([site.loop.target_px.az, site.loop.target_px.el])
    with streaming(site) as camera, powered(site) as motors:
        watch = Watch(site, camera, motors)
        moves = [_rough(site, watch, axis) for axis in range(2)]
        rough = np.array([one[0] for one in moves]).T
        place_px = moves[1][1]
        if abs(np.linalg.det(rough)) < 0.05 * np.linalg.norm(rough) ** 2:
            msg = (
                "both motors move the star along the same line; check the cables from the "
                "amplifiers to the motors, "
                "and the siderostat's mount"
            )
            raise StepError(msg, {"furthest_rad": motors.furthest_rad})
        watch.follow(place_px, rough)
        if len(site.rig.stellar_loops) > 1:
            _refuse_meeting(site, watch.places_px(), place_px, target_px)
        for _ in range(3):
            off_px = target_px - watch.place_px()
            if np.max(np.abs(off_px)) < _NEAR_PX:
                break
            site.report(
                f"the star is az {-off_px[0]:+.1f}, el {-off_px[1]:+.1f} px from its target"
            )
            watch.turn_to(watch.goal_rad + np.linalg.solve(rough, off_px))
        size = min(FINE_RAD, 8.0 / float(np.max(np.linalg.norm(rough, axis=0))))
        fine = np.array([_fine(site, watch, axis, size) for axis in range(2)]).T
        furthest_rad = motors.furthest_rad
    return _siderostat_outcome(site, fine / scale.motor_px_per_rad, furthest_rad)


def _refuse_meeting(site: Site, places_px: list[Floats], own_px: Floats, target_px: Floats) -> None:
    """Raise StepError if another star is where the loop's own would be sent."""
    others = [one for one in places_px if np.linalg.norm(one - own_px) > APART_PX]
    near = [one for one in others if np.linalg.norm(one - target_px) < APART_PX]
    if near:
        az, el = near[0]
        msg = (
            f"the motors of {site.name} move the star at az {own_px[0]:.1f}, el {own_px[1]:.1f} px, and "
            f"another star, at az {az:.1f}, el {el:.1f} px, is near the target of {site.name}. Either the "
            f"amplifiers of {site.name} are exchanged with another loop's: exchange their addresses in the rig "
            "file. Or the other star is in the way: move it aside, and repeat the step"
        )
        raise StepError(msg)


def _first(seen: Sequence[Any]) -> Any:
    """The brightest; StepError if there is none."""
    if not len(seen):
        msg = (
            "no star is on the frame any more; look for clouds, and begin with the step star again"
        )
        raise StepError(msg)
    return seen[0]


def _rough(site: Site, watch: Watch, axis: int) -> tuple[Floats, Floats]:
    """Pixels a radian of one motor, from a small step; and where the star is that it moves."""
    site.report(f"{'azimuth' if axis == 0 else 'elevation'}: {ROUGH_RAD:g} rad and back")
    step = ROUGH_RAD * np.eye(2)[axis]
    start_rad = watch.goal_rad.copy()
    watch.turn_to(start_rad - step)
    before = watch.places_px()
    watch.turn_to(start_rad + step)
    after = watch.places_px()
    watch.turn_to(start_rad)
    was_px, is_px = displaced(before, after) or (_first(before), _first(before))
    moved_px = is_px - was_px
    if np.linalg.norm(moved_px) < LEAST_PX:
        name = "azimuth" if axis == 0 else "elevation"
        msg = (
            f"{name}: the motor turned by {2 * ROUGH_RAD:g} rad and the star moved by "
            f"{np.linalg.norm(moved_px):.2f} "
            "px; check the coupling between motor and mirror, and whether this siderostat is the star's"
        )
        raise StepError(
            msg, {} if watch.motors is None else {"furthest_rad": watch.motors.furthest_rad}
        )
    return np.asarray(moved_px / (2 * ROUGH_RAD)), np.asarray((was_px + is_px) / 2)


def _fine(site: Site, watch: Watch, axis: int, size_rad: float) -> Floats:
    """The same from a larger step, twice, from the same side: backlash is taken up before."""
    site.report(f"{'azimuth' if axis == 0 else 'elevation'}: {size_rad:.2f} rad both ways")
    step = size_rad * np.eye(2)[axis]
    start_rad = watch.goal_rad.copy()
    found = []
    for _ in range(2):
        watch.turn_to(start_rad - (1 + _TAKE_UP) * step)
        watch.turn_to(start_rad - step)
        before_px = watch.place_px()
        watch.turn_to(start_rad + step)
        found.append((watch.place_px() - before_px) / (2 * size_rad))
    watch.turn_to(start_rad)
    return np.asarray(np.mean(found, axis=0))


def _siderostat_outcome(site: Site, seen: Floats, furthest_rad: float) -> Outcome:
    """What a measured response, over the expected scale, makes of the rig file."""
    loop = site.loop
    expected = scales(site.rig, loop).siderostat_turn
    flip_name, flip = "", np.eye(2)
    if np.linalg.det(seen) < 0:
        flip_name, flip = min(
            _FLIPS.items(), key=lambda one: round(abs(similar(seen @ one[1]).rotation_deg) / 45)
        )
    hand = seen @ flip
    now, off = similar(hand), similar(hand @ np.linalg.inv(expected))
    relative = off.scale
    figures = {
        "scale": now.scale,
        "scale_over_expected": relative,
        "rotation_deg": now.rotation_deg,
        "uneven": now.uneven,
        "furthest_rad": furthest_rad,
    }
    lines = [
        f"a radian of motor moves the star by {relative:.3f} of what is expected, turned by "
        f"{now.rotation_deg:+.1f} "
        f"degrees{', ' + flip_name if flip_name else ''}"
    ]
    found: dict[str, Any] = {}
    if flip_name:
        found["wiring"] = _flipped(site, flip)
    turned_deg = loop.siderostat.rotation_deg
    if abs(off.rotation_deg) > ROTATION_APART_DEG:
        turned_deg = found["rotation_deg"] = turned_further(turned_deg, off.rotation_deg)
    if off.uneven > EVEN:
        found["axis_gains"] = gains_of(hand, turned_deg)
        lines.append(uneven_line(off))
    elif abs(relative - 1) > SCALE_APART:
        found["spur_gear_ratio"] = round(loop.siderostat.spur_gear_ratio / relative, 2)
        if relative < 1:  # the motors' own travel stays as it was
            travel_arcsec = loop.siderostat.travel_sky_arcsec * relative
            found["travel_sky_arcsec"] = round(travel_arcsec * 0.995, 1)
        lines.append(
            "the gear is assumed to be the cause; if its data sheet agrees with the rig file, correct "
            "ball_screw_m_per_rad, lever_arm_m or optics.focal_length_m instead"
        )
    return Outcome(lines, figures, site.found(siderostat=found) if found else {})


def _flipped(site: Site, flip: Floats) -> dict[str, Any]:
    """The wiring with its axes exchanged, or with one of them the other way round."""
    old = site.loop.siderostat.wiring or STRAIGHT
    if flip[0, 0] == 0:
        return {key: getattr(old, key)[::-1] for key in type(old).model_fields}
    signs = [int(flip[0, 0]), int(flip[1, 1])]
    return {
        "axes": list(old.axes),
        "velocity_signs": [a * b for a, b in zip(old.velocity_signs, signs, strict=True)],
        "encoder_signs": [a * b for a, b in zip(old.encoder_signs, signs, strict=True)],
    }
