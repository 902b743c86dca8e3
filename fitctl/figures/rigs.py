"""Rigs that differ from a given one in a few values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fitctl.config import Rig, lay_over, rig_from_document


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
    """500 Hz with a delay of 1.75 frames as in the laboratory, and as much light in each frame."""
    camera = {"frame_rate_hz": 500.0, "exposure_s": 0.001, "frame_delay_s": 0.0035}
    return changed(rig, {"camera": camera})
