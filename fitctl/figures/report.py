"""What the figures and the measurements came to, as Markdown for people and JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from fitctl.config import Rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.bound import bound
from fitctl.figures.performance import (
    AT_HZ,
    ROUGH_BACKLASH_TIMES,
    ROUGH_HYSTERESIS,
    Residual,
    Row,
    arcsec,
)
from fitctl.figures.plate import Plate, table
from fitctl.figures.rigs import at_flight_rate
from fitctl.figures.steps import FAR_STEP_PX, JOG_PX

PAPER_ATTENUATION = 10.0
PAPER_RMS_PX = 1 / 35


def write_figures(rig: Rig, seed: int, plates: Sequence[Plate], folder: Path) -> None:
    """``figures.md`` and ``figures.json``."""
    lines = [
        "# The paper's figures, from this system",
        "",
        f"Rig {rig.name}, seed {seed}. Made by `fitctl figures`. Every figure is here as PNG and as SVG. "
        "Ratio is ours over the paper's; where the paper prints no number there is none.",
    ]
    for plate in plates:
        lines += ["", *plate.markdown()]
    _write(folder / "figures.md", lines)
    _write_json(
        folder / "figures.json",
        {"rig": rig.name, "seed": seed, "figures": [plate.plain() for plate in plates]},
    )


def write_performance(
    rig: Rig, loop_name: str, rows: Sequence[Row], runs: str, folder: Path
) -> None:
    """``performance.md`` and ``performance.json``; `runs` says in words how many of what."""
    flight = at_flight_rate(rig)
    least, flight_least = (bound(basis(one, loop_name)).residual_px for one in (rig, flight))
    lines = [
        "# What it shows",
        "",
        f"Rig {rig.name}, loop {loop_name}, full nonlinear plant. {runs} Made by `fitctl figures`.",
        "",
        "## Residual",
        "",
        "True RMS about the target in continuous time, from 10 s after VERNIER on: mean of seeds, worst "
        f"axis, ± one standard deviation over seeds. Bound: {least:.4f} px, "
        f"{arcsec(rig, loop_name, least):.4f} arcsec on the sky. The paper's rig reached 1/35 px = "
        f"{PAPER_RMS_PX:.4f} px by its centroids. Rough: {100 * ROUGH_HYSTERESIS:.0f} % hysteresis and "
        f"{ROUGH_BACKLASH_TIMES:g} times the backlash, of which neither rig file nor design is told. "
        "Piston: RMS about its mean of Eq. 4 for the true displacements of the stacks.",
        "",
        *table(
            [
                "controller",
                "rms px",
                "of bound",
                "rough px",
                "of bound",
                "paper's / ours",
                "piston nm",
            ],
            [
                [
                    row.controller,
                    *_residual(row.nominal),
                    *_residual(row.rough),
                    f"{PAPER_RMS_PX / row.nominal.rms_px:.2f}",
                    f"{1e9 * row.nominal.piston_m:.1f}",
                ]
                for row in rows
            ],
        ),
        "",
        f"## Attenuation at {AT_HZ:g} Hz",
        "",
        "Measured from ticks as a log has them: the open loop is rebuilt as the error less where mirror and "
        "siderostat had moved the star at mid-exposure; both spectra by Welch's method. The design's is of "
        "the linear sampled loop. The paper says 10.",
        "",
        *table(
            ["controller", "measured", "design", "paper", "measured / paper"],
            [
                [
                    row.controller,
                    f"{row.attenuation:.2f}",
                    f"{row.design.shape.attenuation.get(AT_HZ, math.nan):.2f}",
                    f"{PAPER_ATTENUATION:g}",
                    f"{row.attenuation / PAPER_ATTENUATION:.2f}",
                ]
                for row in rows
            ],
        ),
        "",
        "## Steps and jogs",
        "",
        f"Seconds until the true star stays within {rig.loops[loop_name].requirement_px:g} px: after it "
        f"jumped by {FAR_STEP_PX:g} px, after its target did (through the prefilter), and the longest "
        f"of the jogs of ±{JOG_PX:g} px. Overshoot is how far the star went beyond, air path included; "
        "saturated is for how long the mirror's wanted angle was out of reach.",
        "",
        *table(
            [
                "controller",
                "star s",
                "overshoot px",
                "saturated s",
                "target s",
                "overshoot px",
                "saturated s",
                "jog s",
                "saturated s",
            ],
            [
                [
                    row.controller,
                    *(
                        text
                        for step in (row.steps.star, row.steps.target)
                        for text in (
                            _seconds(step.settled_s),
                            f"{step.overshoot_px:.2f}",
                            f"{step.saturated_s:.2f}",
                        )
                    ),
                    _seconds(row.steps.jog_s),
                    f"{row.steps.jog_saturated_s:.2f}",
                ]
                for row in rows
            ],
        ),
        "",
        "## Flight rate",
        "",
        f"The same designs at 500 Hz with 3.5 ms of delay, beside their bound of {flight_least:.5f} px. The "
        "continuous compensators stay as they are; the predicting ones follow rate and delay.",
        "",
        *table(
            ["controller", "rms px", "of bound"],
            [[row.controller, *_residual(row.flight)] for row in rows],
        ),
    ]
    _write(folder / "performance.md", lines)
    plain = [
        row._asdict()
        | {
            "nominal": row.nominal._asdict(),
            "rough": row.rough._asdict(),
            "flight": row.flight._asdict(),
            "design": {
                "attenuation": row.design.shape.attenuation.get(AT_HZ, math.nan),
                "residual_px": row.design.residual_px,
                "ratio_to_bound": row.design.ratio_to_bound,
            },
            "steps": {
                "star": row.steps.star._asdict(),
                "target": row.steps.target._asdict(),
                "jog_s": row.steps.jog_s,
                "jog_saturated_s": row.steps.jog_saturated_s,
            },
        }
        for row in rows
    ]
    numbers = {"rig": rig.name, "loop": loop_name, "runs": runs, "bound_px": least}
    numbers |= {"flight_bound_px": flight_least, "controllers": plain}
    _write_json(folder / "performance.json", numbers)


def _residual(found: Residual) -> list[str]:
    if math.isnan(found.rms_px):
        return ["not held by every seed", ""]
    spread = "" if math.isnan(found.seed_sd_px) else f" ± {found.seed_sd_px:.5f}"
    return [f"{found.rms_px:.5f}{spread}", f"{found.ratio_to_bound:.3f}"]


def _seconds(value: float) -> str:
    return "not in time" if math.isnan(value) else f"{value:.1f}"


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_json(path: Path, value: dict[str, Any]) -> None:
    # What is not a number becomes null.
    path.write_bytes(msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")
