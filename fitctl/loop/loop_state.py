"""One loop as consoles show it: its newest state and what its numbers are to be judged by."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.controllers.spiral import plan_spiral
from fitctl.loop.loop import StellarLoop
from fitctl.messages.modes import Mode, usable_commands
from fitctl.messages.telemetry import LoopLimits, LoopState, SpotPlace
from fitctl.model.optics import scales


def loop_state(rig: Rig, loop: StellarLoop, now_s: float) -> LoopState:
    """The newest of everything; may be asked from any thread."""
    scale = scales(rig, loop.settings)
    mode = loop.mode
    centre_sky_arcsec = (loop.search.centre_rad * scale.motor_sky_arcsec_per_rad).tolist()
    az_urad, el_urad = (1e6 * loop.stages.bias_offset_rad).tolist()
    return LoopState(
        name=loop.name,
        mode=mode.name,
        since_s=loop.mode_since_s,
        requirement_px=loop.settings.requirement_px,
        sky_arcsec_per_px=scale.sky_arcsec_per_px,
        usable_commands=[trigger.name.capitalize() for trigger in usable_commands(mode)],
        controller=loop.controller,
        last_change=loop.last_change,
        interlocks=list(loop.interlocks.tripped),
        limits=_limits(rig, loop.name),
        watched=loop.interlocks.watched(now_s, loop.quantities.readings),
        bias_offset_urad=(az_urad, el_urad),
        search_centre_sky_arcsec=tuple(centre_sky_arcsec) if mode is Mode.ACQUISITION else None,
        other_spots=[
            SpotPlace(
                name=spot.name, az_offset_px=spot.offset_px.az, el_offset_px=spot.offset_px.el
            )
            for spot in loop.settings.other_spots
        ],
        controller_file=loop.pointing.design.file,
    )


def _limits(rig: Rig, name: str) -> LoopLimits:
    loop = rig.loops[name]
    return LoopLimits(
        fsm_range_rad=loop.fsm.range_rad,
        siderostat_travel_sky_arcsec=loop.siderostat.travel_sky_arcsec,
        search_radius_sky_arcsec=loop.acquisition.search_radius_sky_arcsec,
        spiral_pitch_sky_arcsec=plan_spiral(rig, name).pitch_px
        * scales(rig, loop).sky_arcsec_per_px,
    )
