"""Rigs that differ from a given one in a few values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fitctl.config import Rig, lay_over, rig_from_document
from fitctl.config.addresses import BAUD_RATES

_FLIGHT_WRITES = 2  # 1 ms apart, which is the least that a rig file may have


def changed(rig: Rig, fragment: Mapping[str, Any]) -> Rig:
    """A rig with a fragment laid over it.

    Raises
    ------
    ConfigError
        If the result is no rig.
    """
    document = rig.model_dump()
    lay_over(document, fragment)
    return rig_from_document(document, rig.name)


def with_controller(rig: Rig, loop_name: str, controller: str) -> Rig:
    """A rig whose loop works with another design."""
    return changed(rig, {"loops": {loop_name: {"vernier": {"controller": controller}}}})


def with_rougher_stages(rig: Rig, loop_name: str, hysteresis: float, backlash_times: float) -> Rig:
    """A plant with another loop width of its stacks, and more backlash; what is believed of it stays."""
    truth, _ = rig.mock_parts()
    backlash_arcsec = truth.stellar_loops[loop_name].backlash_sky_arcsec * backlash_times
    stages = {
        "hysteresis": {"loop_width_fraction": hysteresis},
        "backlash_sky_arcsec": backlash_arcsec,
    }
    return changed(rig, {"plant": {"loops": {loop_name: stages}}})


def at_flight_rate(rig: Rig) -> Rig:
    """500 Hz with a delay of 1.75 frames as in the laboratory, and as much light in each frame.

    The D/A of the laboratory may be too slow for that: here, it is written as often as a frame leaves time for,
    and a serial line is as fast as any.
    """
    camera = {"frame_rate_hz": 500.0, "exposure_s": 0.001, "frame_delay_s": 0.0035}
    loops = {
        name: {
            "fsm": {
                "dac": {
                    "writes_per_frame": min(loop.fsm.dac.writes_per_frame, _FLIGHT_WRITES),
                    "baud_rate": max(BAUD_RATES),
                }
            }
        }
        for name, loop in rig.stellar_loops.items()
    }
    return changed(rig, {"camera": camera, "loops": loops})
