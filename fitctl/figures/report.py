"""What the figures and the measurements came to, as Markdown for people and JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from fitctl.config import Rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.figures.pages import write_json, write_page
from fitctl.figures.performance import AT_HZ, ROUGH_BACKLASH_TIMES, ROUGH_HYSTERESIS, Row
from fitctl.figures.plate import Plate
from fitctl.figures.rigs import at_flight_rate
from fitctl.figures.steps import FAR_STEP_PX, JOG_PX
from fitctl.model.optics import scales

PAPER_ATTENUATION = 10.0
PAPER_RMS_PX = 1 / 35


def write_figures(rig: Rig, seed: int, plates: Sequence[Plate], folder: Path) -> None:
    """``figures.md`` and ``figures.json``."""
    write_page(
        folder / "figures.md", "fitctl.figures", "figures.md.j2", rig=rig, seed=seed, plates=plates
    )
    figures = [plate.plain() for plate in plates]
    write_json(folder / "figures.json", {"rig": rig.name, "seed": seed, "figures": figures})


def write_performance(
    rig: Rig, loop_name: str, rows: Sequence[Row], runs: str, folder: Path
) -> None:
    """``performance.md`` and ``performance.json``; `runs` says in words how many of what."""
    flight = at_flight_rate(rig)
    bound_px, flight_bound_px = (bound(basis(one, loop_name)).residual_px for one in (rig, flight))
    write_page(
        folder / "performance.md",
        "fitctl.figures",
        "performance.md.j2",
        rig=rig,
        loop=loop_name,
        rows=rows,
        runs=runs,
        bound_px=bound_px,
        bound_sky_arcsec=bound_px * scales(rig, rig.stellar_loops[loop_name]).sky_arcsec_per_px,
        flight_bound_px=flight_bound_px,
        at_hz=AT_HZ,
        rough_hysteresis=ROUGH_HYSTERESIS,
        rough_backlash_times=ROUGH_BACKLASH_TIMES,
        far_step_px=FAR_STEP_PX,
        jog_px=JOG_PX,
        paper_rms_px=PAPER_RMS_PX,
        paper_attenuation=PAPER_ATTENUATION,
    )
    numbers = {
        "rig": rig.name,
        "loop": loop_name,
        "runs": runs,
        "bound_px": bound_px,
        "flight_bound_px": flight_bound_px,
        "controllers": [asdict(row) | {"design": _design(row)} for row in rows],
    }
    write_json(folder / "performance.json", numbers)


def _design(row: Row) -> dict[str, float]:
    return {
        "attenuation": row.design.shape.attenuation.get(AT_HZ, math.nan),
        "residual_px": row.design.residual_px,
        "ratio_to_bound": row.design.ratio_to_bound,
    }
