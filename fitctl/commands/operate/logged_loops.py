"""What a log of an older fitctl lacks of its loops, from the rig file in it."""

from __future__ import annotations

from typing import Any

from fitctl.config import ARCSEC_PER_RAD, ConfigError, rig_from_log
from fitctl.loop.metrology import metrology_limits
from fitctl.loop.stellar import stellar_limits
from fitctl.messages.telemetry import LoopState
from fitctl.model.optics import sky_px_per_rad


def loops_at_start(rig_json: str) -> list[LoopState]:
    """The loops of a logged rig, in OFF, in the order of the rig file; none if the rig cannot be read."""
    try:
        rig = rig_from_log(rig_json, "the rig in the log")
    except ConfigError:
        return []
    sky_arcsec_per_px = ARCSEC_PER_RAD / sky_px_per_rad(rig)
    off: dict[str, Any] = {
        "mode": "OFF",
        "since_s": 0.0,
        "usable_commands": [],
        "sky_arcsec_per_px": sky_arcsec_per_px,
    }
    states = {
        name: LoopState(
            name=name,
            requirement_px=loop.requirement_px,
            limits=stellar_limits(rig, name),
            **off,
        )
        for name, loop in rig.stellar_loops.items()
    } | {
        name: LoopState(
            name=name,
            kind="metrology",
            requirement_px=metrology.requirement_arcsec / sky_arcsec_per_px,
            limits=metrology_limits(rig, name),
            **off,
        )
        for name, metrology in rig.metrology_loops.items()
    }
    return [states[name] for name in rig.loops]
