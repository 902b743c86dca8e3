"""An operator moves the stages by hand, in STANDBY."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, Rig
from fitctl.loop.loop import Loop
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import Jog, SetBiasOffset
from fitctl.messages.modes import Mode
from fitctl.model.optics import sky_px_per_rad

Floats = NDArray[np.float64]


def jog_siderostats(rig: Rig, loops: Sequence[Loop], command: Jog) -> str:
    """Move the siderostats of `loops`, all of them or none.

    Returns
    -------
    str
        Why none was moved, and what to do; empty where all were.
    """
    step_sky_arcsec = np.array([command.az_sky_arcsec, command.el_sky_arcsec])
    why_not = _not_in_standby(loops) or next(
        filter(None, (_beyond(rig, loop, step_sky_arcsec) for loop in loops)), ""
    )
    for loop in () if why_not else loops:
        loop.jog(step_sky_arcsec)
    return why_not


def offset_mirrors(_rig: Rig, loops: Sequence[StellarLoop], command: SetBiasOffset) -> str:
    """Move the mirrors of `loops`, as :func:`jog_siderostats`."""
    offset_rad = 1e-6 * np.array([command.az_urad, command.el_urad])
    why_not = _not_in_standby(loops) or next(
        filter(None, (_off_the_diamond(loop, offset_rad) for loop in loops)), ""
    )
    for loop in () if why_not else loops:
        loop.mirror.rest_off_bias(offset_rad)
    return why_not


def _not_in_standby(loops: Sequence[Loop]) -> str:
    for loop in loops:
        if loop.mode is not Mode.STANDBY:
            todo = "while a star is held, move the target"
            if not isinstance(loop, StellarLoop):
                todo = "while its beam is held, release it first"
            return f"stages are moved by hand only in STANDBY (is {loop.mode.name}); {todo}"
    return ""


def _beyond(rig: Rig, loop: Loop, step_sky_arcsec: Floats) -> str:
    """A slip of the finger must not lead far from the star, nor to the end of the travel."""
    field_px = min(rig.camera.width_px, rig.camera.height_px)
    most_arcsec = field_px / sky_px_per_rad(rig) * ARCSEC_PER_RAD
    if not np.abs(step_sky_arcsec).max() <= most_arcsec:  # not-a-number too
        return f"a jog is at most a field of view, {most_arcsec:.1f} arcsec on the sky"
    stage, settings = loop.siderostat, loop.settings.siderostat
    step_rad = step_sky_arcsec / ARCSEC_PER_RAD / settings.sky_rad_per_motor_rad
    away_rad = np.abs(stage.setpoint_rad + step_rad)
    # One that has turned on beyond its travel can be jogged back.
    if np.any((away_rad > stage.travel_rad) & (away_rad > np.abs(stage.setpoint_rad))):
        return (
            f"siderostat {loop.name} would leave its travel of ±{settings.travel_sky_arcsec:g} arcsec on "
            "the sky; jog the other way"
        )
    return ""


def _off_the_diamond(loop: StellarLoop, offset_rad: Floats) -> str:
    range_rad = loop.settings.fsm.range_rad
    if not np.abs(offset_rad).sum() <= range_rad:
        return (
            f"|az| + |el| of a bias offset must be within the mirror's {1e6 * range_rad:.1f} urad"
        )
    return ""
