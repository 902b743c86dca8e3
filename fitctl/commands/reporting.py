"""Command lines of what a log shows: a report of a night, a plot at a glance."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.choosing import rig_of


def report(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Files of one run, or a folder: its newest run."),
    ],
    compare: Annotated[
        bool, typer.Option("--compare", help="Each LOG is a night of its own; side by side.")
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="As PDF too; needs Chromium or Chrome.")
    ] = False,
    show: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for everything; else beside the first LOG."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Judge by this rig file, not by the one in the log."),
    ] = None,
) -> None:
    """Say on one page whether a night was good: verdict, plots, losses, configuration.

    One HTML file that needs nothing from elsewhere, every plot as PNG and SVG, all figures as JSON.
    """
    from fitctl.commands.report import run_report

    settings = None if rig is None else rig_of(rig, None)
    raise typer.Exit(run_report(logs, settings, out, compare=compare, show=show, pdf=pdf))


def plot(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="An MCAP file, finished or not.")],
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="TOPIC...",
            help="/fit/right/tick.error_az_px, a topic, or a field; * is anything.",
        ),
    ],
    from_: Annotated[
        str, typer.Option("--from", metavar="TIME", help="Seconds after LOG's start, or UTC.")
    ] = "0",
    to: Annotated[str | None, typer.Option("--to", metavar="TIME", help="The same.")] = None,
    window: Annotated[
        bool, typer.Option("--window", help="In a window, not in the terminal.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="As a picture: PNG, SVG or PDF.")
    ] = None,
) -> None:
    """Draw fields of a log in the terminal, one panel for each unit."""
    from fitctl.commands.plot import run_plot

    raise typer.Exit(run_plot(log, what, (from_, to), window=window, out=out))
