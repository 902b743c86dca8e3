"""`fitctl figures`: the paper's figures and the table of performance, made from this system."""

from __future__ import annotations

from pathlib import Path

import typer

from fitctl.commands.exits import FAILED
from fitctl.commands.printing import progress_line
from fitctl.config import ConfigError, Rig
from fitctl.figures.make import FULL, QUICK, make
from fitctl.identify.errors import IdentifyError


def run_figures(rig: Rig, loop_name: str, seed: int, out: Path, *, quick: bool) -> int:
    """Make everything and say where it is; returns the exit status."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"figures: --out {out}: cannot be made a folder: {error.strerror}; name one you may write in"
        raise ConfigError(msg) from None
    amount = QUICK if quick else FULL
    try:
        with progress_line() as progress:
            task = progress.add_task("figures", total=1.0)
            plates, rows = make(
                rig, loop_name, seed, out, amount,
                lambda part: progress.update(task, completed=part),
            )  # fmt: skip
    except OSError as error:
        msg = f"figures: --out {out}: cannot be written: {error}; make room or name another folder"
        raise ConfigError(msg) from None
    except (IdentifyError, RuntimeError) as error:
        typer.echo(f"figures: {error}", err=True)
        return FAILED
    for plate in plates:
        typer.echo(plate.title)
    for row in rows:
        nominal = row.nominal
        typer.echo(
            f"{row.controller:<17} {nominal.rms_px:.4f} px RMS, {nominal.ratio_to_bound:.3f} of the bound; "
            f"{row.attenuation:.1f}x at 1 Hz"
        )
    typer.echo(f"written: {out / 'figures.md'}, {out / 'performance.md'}, and JSON beside each")
    return 0
