"""`fitctl figures`: the paper's figures and the table of performance, made from this system."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import LoopOption, SeedOption, SetOption, ShippedRigOption
from fitctl.commands.shared.plant import require_plant
from fitctl.commands.shared.printing import progress_line, say
from fitctl.commands.shared.rig import require_loop, rig_of
from fitctl.config import ConfigError
from fitctl.figures.make import FULL, QUICK, make
from fitctl.identify.errors import IdentifyError


def figures(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write; created if missing.")],
    rig: ShippedRigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    seed: SeedOption = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Make few and short runs, for a first look.")
    ] = False,
) -> None:
    """Make the paper's figures from this system, and measure every controller.

    Writes Figs. 3, 5, 6, 7, 9, 11 and 12 as PNG and SVG, and figures.md with captions and the paper's numbers
    beside ours. performance.md has residuals, attenuation, steps and piston. Writes both tables as JSON too.
    """
    settings = rig_of(rig, overrides)
    require_plant(settings)
    require_loop("figures", settings, loop)
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()  # known before minutes of work
    except OSError as error:
        msg = f"figures: --out {out}: no folder to write in: {error.strerror}; name one you may write in"
        raise ConfigError(msg) from None
    amount = QUICK if quick else FULL
    try:
        with progress_line("figures") as progress:
            plates, rows = make(settings, loop, seed, out, amount, progress)
    except OSError as error:
        msg = f"figures: --out {out}: cannot be written: {error}; make room or name another folder"
        raise ConfigError(msg) from None
    except (IdentifyError, RuntimeError) as error:
        say(f"figures: {error}", err=True)
        raise typer.Exit(FAILED) from None
    for plate in plates:
        say(plate.title)
    for row in rows:
        nominal = row.nominal
        say(
            f"{row.controller:<17} {nominal.rms_px:.4f} px RMS, {nominal.ratio_to_bound:.3f} of the bound; "
            f"{row.attenuation:.1f}x at 1 Hz"
        )
    say(f"written: {out / 'figures.md'}, {out / 'performance.md'}, and JSON beside each")
