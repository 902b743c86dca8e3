"""The search for a metrology beam: its siderostat goes along a spiral until a photodiode has light."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.controllers.spiral import plan_beam_spiral
from fitctl.loop.search.spiral import SpiralSearch, Wanted
from fitctl.messages.modes import Trigger
from fitctl.model.optics import motor_sky_rad_per_rad, sky_px_per_rad

_CHECK = "the laser and its path"
_BEAM = Wanted(
    name="beam",
    found=Trigger.BEAM_FOUND,
    confirmed="light on {} samples in a row",
    rejected="light was not confirmed; the search for the beam goes on",
    check=_CHECK,
    check_long=_CHECK,
)


def beam_search(rig: Rig, loop_name: str) -> SpiralSearch:
    """The search of a metrology loop."""
    loop = rig.metrology_loops[loop_name]
    rad_per_px = 1.0 / (motor_sky_rad_per_rad(loop.siderostat) * sky_px_per_rad(rig))
    return SpiralSearch(
        _BEAM,
        loop.acquisition,
        lambda radius: plan_beam_spiral(rig, loop_name, radius_sky_arcsec=radius),
        lambda offset_px: rad_per_px * offset_px,
    )
