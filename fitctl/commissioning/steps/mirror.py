"""The star moved by each of the mirror's stacks: order, scale, rotation, mirror images."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from fitctl.commissioning.outcome import BEFORE, Outcome, Site, StepError
from fitctl.commissioning.steps import stacks
from fitctl.commissioning.steps.camera import streaming
from fitctl.commissioning.steps.plate import (
    EVEN,
    LEAST_PX,
    ROTATION_APART_DEG,
    SCALE_APART,
    Floats,
    similar,
    turned_further,
    uneven_line,
)
from fitctl.commissioning.steps.sky import Watch, displaced
from fitctl.config import Fsm
from fitctl.controllers.mirror import Mirror
from fitctl.model.optics import gains_of, scales, stage_turn

_STACK_V = 2.5
_OF_RANGE = 0.9  # of what tilts the mirror by its range: where that is less, so far
_SWINGS = 3
_SURELY_EXCHANGED = 0.15  # better in `_unlike`; with even axes, another order is better by 0.45
_SAME_SCALE = 0.1  # by which two stages' scales may differ and have one cause


def moves(site: Site) -> str:
    """What the step moves."""
    fsm = site.loop.fsm
    volts = _stack_v(fsm)
    return (
        f"all stacks to {fsm.bias_v:g} V at the D/A, then each by {volts:.3g} V both ways, "
        f"{fsm.piezo.gain * volts:.3g} V at the stack, one after the other"
    )


def _stack_v(fsm: Fsm) -> float:
    """How far a stack is moved from its bias, at the D/A."""
    return min(_STACK_V, _OF_RANGE * fsm.swing_v)


def check_mirror(site: Site) -> Outcome:
    """How the star moves with each stack.

    Raises
    ------
    StepError
        If it does not.
    """
    with streaming(site) as camera, stacks.opened(site) as held:
        watch = Watch(site, camera, None)
        watch.follow(np.array([site.loop.target_px.az, site.loop.target_px.el]))
        fsm = site.loop.fsm
        model = Mirror(fsm)
        held.slew(np.full(3, fsm.bias_v), fsm.slew_v_per_s)
        seen, expected = [], []
        for stack in range(3):
            site.report(f"stack {stack + 1}: {_stack_v(fsm):.3g} V both ways")
            moved_px, modelled_px = _swing(site, watch, held, model, stack)
            seen.append(moved_px)
            expected.append(modelled_px)
        furthest_v = held.furthest_v
        if len(site.rig.stellar_loops) > 1 and not any(map(_moved, seen)):
            _refuse_another_star(site, watch, held)
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
            goal_v = bias_v + way * _stack_v(fsm) * np.eye(3)[stack]
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


def _moved(moved_px: Floats) -> bool:
    return bool(np.linalg.norm(moved_px) >= LEAST_PX / 2)


def _refuse_another_star(site: Site, watch: Watch, held: stacks.Stacks) -> None:
    """Raise StepError if the mirror moves a star, and not the one that this loop's siderostat moves."""
    fsm = site.loop.fsm
    bias_v = np.full(3, fsm.bias_v)
    before = watch.places_px(12)
    held.slew(bias_v + _stack_v(fsm) * np.eye(3)[0], fsm.slew_v_per_s)
    held.set(held.volts)
    after = watch.places_px(12)
    held.slew(bias_v, fsm.slew_v_per_s)
    if displaced(before, after) is not None:
        others = ", ".join(name for name in site.rig.loops if name != site.name)
        msg = (
            f"the mirror of {site.name} moves another star than its siderostat: the amplifiers of {site.name} "
            f"and those of another loop ({others}) are exchanged, or the D/A is; exchange their addresses "
            "in the rig file"
        )
        raise StepError(msg, {"furthest_v": held.furthest_v})


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
        if not _moved(seen[stack]):
            msg = (
                f"stack {stack + 1}: the amplifier drives it and the star moved by "
                f"{np.linalg.norm(seen[stack]):.2f} "
                "px; check the cable from the amplifier to the stack, and the stack"
            )
            raise StepError(msg, figures)
    own = (0, 1, 2)
    unlike = {one: _unlike(seen, expected[list(one)]) for one in itertools.permutations(range(3))}
    likeliest = min(unlike, key=lambda one: unlike[one])
    # Stacks exchanged in a circle look much like a mirror that is turned and has uneven axes.
    order = own if unlike[own] - unlike[likeliest] < _SURELY_EXCHANGED else likeliest
    matrix = _fit(seen, expected[list(order)])
    if unlike[order] > 0.5:
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
    stacks_of_outputs = ", ".join(str(one + 1) for one in likeliest)
    if order != likeliest:
        lines.append(
            f"the amplifier's outputs 1, 2, 3 may also be on stacks {stacks_of_outputs}; check the cables"
        )
    if order != own:
        lines.append(f"the amplifier's outputs 1, 2, 3 are on stacks {stacks_of_outputs}")
        for device in ("dac", "piezo"):
            old = getattr(fsm, device).channels or [1, 2, 3]
            found[device] = {"channels": [old[order.index(stack)] for stack in range(3)]}
    turned_deg = fsm.rotation_deg
    if abs(now.rotation_deg) > ROTATION_APART_DEG:
        turned_deg = found["rotation_deg"] = turned_further(turned_deg, now.rotation_deg)
    scaled = abs(now.scale - 1) > 2 * SCALE_APART
    if scaled and (common := _common_scale(site, now.scale)):
        lines.append(
            "the siderostat's scale differs by the same factor: the focal length is assumed to be the "
            "cause of both, and the gear stays as in the rig file"
        )
        return Outcome(lines, figures, common)
    if now.uneven > EVEN:
        lines.append(uneven_line(now))
    if scaled or now.uneven > EVEN:
        whole = matrix @ stage_turn(fsm.rotation_deg, fsm.axis_gains)
        found["axis_gains"] = gains_of(whole, turned_deg)
    return Outcome(lines, figures, site.found(fsm=found) if found else {})


def _common_scale(site: Site, scale: float) -> dict[str, Any]:
    """What corrects the mirror's scale and the siderostat's at once, if both were wrong by the same."""
    figures = site.figures
    before = figures.get(f"{site.name}.siderostat.scale_over_expected{BEFORE}", 1.0)
    if abs(scale / before - 1) > _SAME_SCALE or len(site.rig.stellar_loops) > 1:
        return {}
    siderostat = site.loop.siderostat
    focal_m = site.rig.optics.focal_length_m * scale
    back: dict[str, Any]
    # Where the axes were uneven, the siderostat's step has put the scale into the gains.
    if figures.get(f"{site.name}.siderostat.uneven{BEFORE}", 1.0) > EVEN:
        turn = stage_turn(siderostat.rotation_deg, siderostat.axis_gains)
        back = {"axis_gains": gains_of(turn / before, siderostat.rotation_deg)}
    else:
        back = {
            "spur_gear_ratio": round(siderostat.spur_gear_ratio * before, 2),
            "travel_sky_arcsec": round(siderostat.travel_sky_arcsec / min(before, 1.0), 1),
        }
    return {"optics": {"focal_length_m": round(focal_m, 4)}} | site.found(siderostat=back)


def _fit(seen: Floats, expected: Floats) -> Floats:
    """The matrix that maps expected motions (rows) to measured ones."""
    return np.asarray(np.linalg.lstsq(expected, seen, rcond=None)[0].T, dtype=float)


def _unlike(seen: Floats, expected: Floats) -> float:
    """How far that matrix is from a rotation with a scale; large where it is a mirror image."""
    matrix = _fit(seen, expected)
    (a, b), (c, d) = matrix
    turned = np.array([[a + d, b - c], [c - b, a + d]]) / 2
    return float(np.linalg.norm(matrix - turned) / max(float(np.linalg.norm(turned)), 1e-9))
