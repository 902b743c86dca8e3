"""The star on the camera, and by how much and which way each stage moves it: scale, rotation, mirror images."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning import stacks
from fitctl.commissioning.camera import streaming
from fitctl.commissioning.motors import powered
from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.sky import Watch, search
from fitctl.config.wiring import STRAIGHT
from fitctl.controllers.mirror import Mirror
from fitctl.model.optics import rotation, scales

Floats = NDArray[np.float64]
ROUGH_RAD = 0.35
FINE_RAD = 1.0
STACK_V = 2.5
_SWINGS = 3
_TAKE_UP = 0.5  # of a step, before it: backlash
_LEAST_PX = 0.7  # by a rough step
_NEAR_PX = 3.0
_SCALE_APART = 0.08
_ROTATION_APART_DEG = 5.0
_EVEN = 1.15  # of the two singular values
_TWIN = 0.8  # of the brightest spot's light
_EDGE_PX = 4.0
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


# ---------------------------------------------------------------- the star
def star_moves(site: Site) -> str:
    """What the step moves."""
    reach = site.loop.acquisition.search_radius_sky_arcsec
    motor = scales(site.rig, site.loop).motor_sky_arcsec_per_rad
    return f"nothing if a star is on the camera; otherwise the motors, up to {reach / motor:.1f} rad each way"


def check_star(site: Site) -> Outcome:
    """Find the star, and compare its light with the rig file.

    Raises
    ------
    StepError
        If there is none, or more than one that could be it.
    """
    with streaming(site) as camera:
        spots = Watch(site, camera, None).spots()
        moved_rad, looks = 0.0, 0
        if not spots:
            with powered(site) as motors:
                watch = Watch(site, camera, motors)
                _, looks = search(site, watch)
                spots = watch.spots()
                moved_rad = motors.furthest_rad
    if not spots:
        msg = "a spot was seen once and is gone; repeat the step"
        raise StepError(msg)
    loop = site.loop
    figures = {
        "flux_dn": spots[0].flux_dn,
        "spots": float(len(spots)),
        "looks": float(looks),
        "furthest_rad": moved_rad,
    }
    lines = [
        f"spot at az {spot.az_px:.1f}, el {spot.el_px:.1f} px: {spot.flux_dn:.0f} DN"
        for spot in spots
    ]
    if len(spots) > 1 and spots[1].flux_dn > _TWIN * spots[0].flux_dn:
        msg = (
            f"two spots could be the star, of {spots[0].flux_dn:.0f} and "
            f"{spots[1].flux_dn:.0f} DN; cover the other "
            "star or another loop's beam, and repeat the step"
        )
        raise StepError(msg, figures)
    low_dn, high_dn = loop.flux_range_dn
    if low_dn <= spots[0].flux_dn <= high_dn:
        return Outcome(lines, figures)
    part = spots[0].flux_dn / loop.star_flux_dn
    other = [
        spot.model_dump() | {"flux_dn": round(spot.flux_dn * part, 1)} for spot in loop.other_spots
    ]
    lines.append(
        f"the star has {part:.2f} of star_flux_dn; its other spots are taken to have so, too"
    )
    return Outcome(
        lines, figures, site.found(star_flux_dn=round(spots[0].flux_dn, 1), other_spots=other)
    )


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
        rough = np.array([_rough(site, watch, axis) for axis in range(2)]).T
        if abs(np.linalg.det(rough)) < 0.05 * np.linalg.norm(rough) ** 2:
            msg = (
                "both motors move the star along the same line; check the cables from the "
                "amplifiers to the motors, "
                "and the siderostat's mount"
            )
            raise StepError(msg, {"furthest_rad": motors.furthest_rad})
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


def _rough(site: Site, watch: Watch, axis: int) -> Floats:
    """Pixels a radian of one motor, from a small step."""
    site.report(f"{'azimuth' if axis == 0 else 'elevation'}: {ROUGH_RAD:g} rad and back")
    step = ROUGH_RAD * np.eye(2)[axis]
    start_rad = watch.goal_rad.copy()
    watch.turn_to(start_rad - step)
    before_px = watch.place_px()
    watch.turn_to(start_rad + step)
    moved_px = watch.place_px() - before_px
    watch.turn_to(start_rad)
    if np.linalg.norm(moved_px) < _LEAST_PX:
        name = "azimuth" if axis == 0 else "elevation"
        msg = (
            f"{name}: the motor turned by {2 * ROUGH_RAD:g} rad and the star moved by "
            f"{np.linalg.norm(moved_px):.2f} "
            "px; check the coupling between motor and mirror, and whether this siderostat is the star's"
        )
        raise StepError(
            msg, {} if watch.motors is None else {"furthest_rad": watch.motors.furthest_rad}
        )
    return np.asarray(moved_px / (2 * ROUGH_RAD))


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
    now, was = similar(hand), similar(expected)
    relative = now.scale / was.scale
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
    apart_deg = (now.rotation_deg - was.rotation_deg + 180) % 360 - 180
    if abs(apart_deg) > _ROTATION_APART_DEG:
        found["rotation_deg"] = round(now.rotation_deg, 1)
    turned = found.get("rotation_deg", loop.siderostat.rotation_deg)
    if now.uneven > _EVEN * was.uneven:
        gains = rotation(turned).T @ hand
        found["axis_gains"] = [[round(float(one), 3) for one in row] for row in gains]
    elif abs(relative - 1) > _SCALE_APART:
        found["spur_gear_ratio"] = round(loop.siderostat.spur_gear_ratio / relative, 2)
        if relative < 1:  # the motors' own travel stays as it was
            travel_arcsec = loop.siderostat.travel_sky_arcsec * relative
            found["travel_sky_arcsec"] = round(travel_arcsec * 0.995, 1)
        lines.append(
            "the gear is taken for the cause; if it is right by its data sheet, correct ball_screw_m_per_rad, "
            "lever_arm_m or optics.focal_length_m instead"
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


# ---------------------------------------------------------------- the mirror
def mirror_moves(site: Site) -> str:
    """What the step moves."""
    gain = site.loop.fsm.piezo.gain
    return (
        f"each stack by {STACK_V:g} V at the D/A both ways, {gain * STACK_V:g} V at the stack, "
        "one after the other"
    )


def check_mirror(site: Site) -> Outcome:
    """How the star moves with each stack.

    Raises
    ------
    StepError
        If it does not.
    """
    with streaming(site) as camera, stacks.opened(site) as held:
        watch = Watch(site, camera, None)
        fsm = site.loop.fsm
        model = Mirror(fsm)
        held.slew(np.full(3, fsm.bias_v), fsm.slew_v_per_s)
        seen, expected = [], []
        for stack in range(3):
            site.report(f"stack {stack + 1}: {STACK_V:g} V both ways")
            moved_px, modelled_px = _swing(site, watch, held, model, stack)
            seen.append(moved_px)
            expected.append(modelled_px)
        furthest_v = held.furthest_v
    return _mirror_outcome(site, np.array(seen), np.array(expected), furthest_v)


def _swing(
    site: Site, watch: Watch, held: stacks.Stacks, model: Mirror, stack: int
) -> tuple[Floats, Floats]:
    """How far the star moved with one stack, and how far it should have.

    The first swing wipes out what the stack remembers of earlier ones, and is not measured.
    """
    fsm = site.loop.fsm
    bias_v = np.full(3, fsm.bias_v)
    moved_px, turned_rad = [], []
    for swing in range(_SWINGS + 1):
        places, angles = [], []
        for way in (-1.0, 1.0):
            goal_v = bias_v + way * STACK_V * np.eye(3)[stack]
            held.slew(goal_v, fsm.slew_v_per_s)
            model.written(goal_v)
            if swing:
                places.append(_kept_place(watch, held))
                angles.append(model.angles_rad.copy())
        if swing:
            moved_px.append(places[1] - places[0])
            turned_rad.append(angles[1] - angles[0])
    held.slew(bias_v, fsm.slew_v_per_s)
    model.written(bias_v)
    modelled_px = scales(site.rig, site.loop).mirror_px(np.mean(turned_rad, axis=0))
    return np.asarray(np.mean(moved_px, axis=0)), np.asarray(modelled_px)


def _kept_place(watch: Watch, held: stacks.Stacks) -> Floats:
    """Where the star is; the D/A is written between looks, for its watchdog."""
    looks = []
    for _ in range(2):
        held.set(held.volts)
        looks.append(watch.place_px(12))
    return np.asarray(np.mean(looks, axis=0))


def _mirror_outcome(site: Site, seen: Floats, expected: Floats, furthest_v: float) -> Outcome:
    """What measured responses of three stacks, rows in pixels, make of the rig file."""
    fsm = site.loop.fsm
    figures = {"furthest_v": furthest_v}
    for stack in range(3):
        if np.linalg.norm(seen[stack]) < _LEAST_PX * 0.5:
            msg = (
                f"stack {stack + 1}: the amplifier drives it and the star moved by "
                f"{np.linalg.norm(seen[stack]):.2f} "
                "px; check the cable from the amplifier to the stack, and the stack"
            )
            raise StepError(msg, figures)
    order = min(
        itertools.permutations(range(3)), key=lambda one: _unlike(seen, expected[list(one)])
    )
    matrix = _fit(seen, expected[list(order)])
    if _unlike(seen, expected[list(order)]) > 0.5:
        msg = (
            "the stacks do not move the star as three corners of a square would; check "
            "that all three carry the "
            "mirror, and stack_radius_m"
        )
        raise StepError(msg, figures)
    now = similar(matrix)
    figures |= {
        "scale_over_expected": now.scale,
        "turned_deg": now.rotation_deg,
        "uneven": now.uneven,
    }
    lines = [
        f"the mirror moves the star by {now.scale:.3f} of what is expected, turned by "
        f"{now.rotation_deg:+.1f} degrees"
    ]
    found: dict[str, Any] = {}
    if order != (0, 1, 2):
        lines.append(
            "the amplifier's outputs 1, 2, 3 are on stacks "
            + ", ".join(str(one + 1) for one in order)
        )
        for device in ("dac", "piezo"):
            old = getattr(fsm, device).channels or [1, 2, 3]
            found[device] = {"channels": [old[order.index(stack)] for stack in range(3)]}
    if abs(now.rotation_deg) > _ROTATION_APART_DEG:
        whole_deg = fsm.rotation_deg + now.rotation_deg
        found["rotation_deg"] = round((whole_deg + 180) % 360 - 180, 1)
    if abs(now.scale - 1) > 2 * _SCALE_APART:
        gains = now.scale * (np.eye(2) if fsm.axis_gains is None else np.array(fsm.axis_gains))
        found["axis_gains"] = [[round(float(one), 3) for one in row] for row in gains]
    return Outcome(lines, figures, site.found(fsm=found) if found else {})


def _fit(seen: Floats, expected: Floats) -> Floats:
    """The matrix that takes expected motions, rows, to those that were seen."""
    return np.asarray(np.linalg.lstsq(expected, seen, rcond=None)[0].T, dtype=float)


def _unlike(seen: Floats, expected: Floats) -> float:
    """How far that matrix is from a rotation with a scale; large where it is a mirror image."""
    matrix = _fit(seen, expected)
    (a, b), (c, d) = matrix
    turned = np.array([[a + d, b - c], [c - b, a + d]]) / 2
    return float(np.linalg.norm(matrix - turned) / max(float(np.linalg.norm(turned)), 1e-9))
