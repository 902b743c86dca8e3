"""The step that searches for a star: wider from attempt to attempt, about where the star is expected."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from fitctl.config import Rig
from fitctl.controllers.spiral import plan_beam_spiral, plan_spiral
from fitctl.loop.search.spiral import refused_area
from fitctl.loop.search.star import refused_search
from fitctl.messages.commands import Acquire, Release, Standby
from fitctl.messages.modes import HOLDING, Mode
from fitctl.model.optics import scales
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Result, stop_tracking
from fitctl.sequences.view import Figures, View

_OF_STARS = (
    "star_flux_dn",
    "field_overlap",
    "rate_az_sky_arcsec_s",
    "rate_el_sky_arcsec_s",
)
_OF_ANOTHER = (
    "expected_az_sky_arcsec",
    "star_flux_dn",
    "rate_az_sky_arcsec_s",
    "rate_el_sky_arcsec_s",
)
_FOUND = ("found_az_sky_arcsec", "found_el_sky_arcsec", "found_flux_dn")


def search_of(step: steps.Acquire, rig: Rig, loop_name: str, attempt: int) -> Acquire:
    """The command that makes an attempt's search, the first of which is 1."""
    radius = step.search_radius_sky_arcsec
    if step.max_offset_sky_arcsec is not None:
        first = radius or rig.loops[loop_name].acquisition.search_radius_sky_arcsec
        radius = min(first * step.radius_growth ** (attempt - 1), step.max_offset_sky_arcsec)
    return Acquire(
        loop=step.loop,
        search_radius_sky_arcsec=radius,
        field_overlap=step.field_overlap,
        expected_az_sky_arcsec=step.expected_az_sky_arcsec,
        expected_el_sky_arcsec=step.expected_el_sky_arcsec,
        star_flux_dn=step.star_flux_dn,
        rate_az_sky_arcsec_s=step.rate_az_sky_arcsec_s,
        rate_el_sky_arcsec_s=step.rate_el_sky_arcsec_s,
    )


def _check(step: steps.Acquire, rig: Rig, loop_name: str) -> list[str]:
    widest = search_of(step, rig, loop_name, step.attempts)
    first = search_of(step, rig, loop_name, 1)
    given = step.search_radius_sky_arcsec
    if given is not None and given != first.search_radius_sky_arcsec:
        return [
            f"search_radius_sky_arcsec passes max_offset_sky_arcsec, {step.max_offset_sky_arcsec:g}"
        ]
    if loop_name not in rig.metrology_loops:
        why_not = refused_search(rig, loop_name, widest)
    elif any(getattr(step, name) is not None for name in _OF_STARS):
        why_not = (
            "star_flux_dn and field_overlap are of a star, as a rate is; "
            f"{loop_name} holds a metrology beam"
        )
    else:
        why_not = refused_area(rig.metrology_loops[loop_name], loop_name, widest)
    return [why_not] if why_not else []


def _own_s(step: steps.Acquire, rig: Rig, loop_name: str) -> float:
    widest = search_of(step, rig, loop_name, step.attempts)
    if loop_name in rig.metrology_loops:
        radius = widest.search_radius_sky_arcsec
        return plan_beam_spiral(rig, loop_name, radius_sky_arcsec=radius).duration_s
    return plan_spiral(
        rig,
        loop_name,
        radius_sky_arcsec=widest.search_radius_sky_arcsec,
        field_overlap=widest.field_overlap,
    ).duration_s


def _run(step: steps.Acquire, view: View) -> None:
    if view.tracking and any(getattr(step, name) is not None for name in _OF_ANOTHER):
        view.command(Release(loop=view.loop_name))  # another star, or the same anew
    if view.mode is Mode.OFF:
        view.command(Standby(loop=step.loop))


def _search(step: steps.Acquire, view: View) -> None:
    search = search_of(step, view.rig, view.loop_name, view.attempt)
    # Without a loop, all of them search at once: each then leaves the others' stars alone. A search of another
    # loop that is under way does not begin anew.
    if view.attempt > 1 or _searching(view):
        search = msgspec.structs.replace(search, loop=view.loop_name)
    view.command(search)
    view.marks.append(view.fresh_s)


def _searching(view: View) -> list[str]:
    """The other loops that search, but not again for a star that they lost."""
    return [
        loop.name
        for loop in view.telemetry.loops
        if loop.name != view.loop_name
        and loop.mode == Mode.ACQUISITION.name
        and loop.search_again is None
    ]


def _stop(step: steps.Acquire, view: View) -> None:
    """End the search, and with the last attempt those of all loops that the step began."""
    stop_tracking(step, view)
    if not step.loop and view.attempt >= step.attempts:
        for name in _searching(view):
            view.ask(Release(loop=name))


def _done(step: steps.Acquire, view: View) -> Result | None:
    view.require_no_failure()
    searches_again = view.loop.search_again is not None
    if (view.mode is Mode.STANDBY or searches_again) and not view.marks:
        _search(step, view)  # the devices are on, and no star is held
        return None
    if view.mode is Mode.OFF:
        return None
    view.require_mode(Mode.ACQUISITION, Mode.COARSE, *HOLDING)
    if view.mode not in HOLDING:
        return None
    figures = {"acquired_s": view.elapsed_s}
    if view.mode is Mode.VERNIER:
        figures |= _found(view)
    return Result(figures, f"held after {view.elapsed_s:.1f} s")


def _found(view: View) -> Figures:
    """Where the star is on the sky, from where the encoders read zero, and its flux; nan without a star."""
    newest = next(
        (one for one in reversed(view.measurements) if math.isfinite(one.star_az_px)), None
    )
    if newest is None:
        return dict.fromkeys(_FOUND, math.nan)
    scale, target = scales(view.rig, view.settings), view.settings.target_px
    beside_px = np.array([newest.star_az_px - target.az, newest.star_el_px - target.el])
    mirror_px = scale.mirror_px(np.array([newest.fsm_az_rad, newest.fsm_el_rad]))
    motor_px = scale.motor_px(np.array([newest.siderostat_az_rad, newest.siderostat_el_rad]))
    az, el = scale.sky_arcsec(beside_px - mirror_px - motor_px).tolist()
    return dict(zip(_FOUND, (az, el, newest.star_flux_dn), strict=True))


ACQUIRE = {
    "acquire": Behaviour(
        frozenset({Mode.OFF, Mode.STANDBY, Mode.ACQUISITION, Mode.COARSE, *HOLDING}),
        _done,
        _run,
        _stop,
        _check,
        _own_s,
        loops="links first",
        of_beams=True,
    )
}
