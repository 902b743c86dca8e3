"""`fitctl plot`: fields of a log at a glance."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.log_time import time_ns
from fitctl.commands.shared.logs import LatestOption, logs_alone
from fitctl.commands.shared.options import RigOption
from fitctl.commands.shared.printing import say
from fitctl.config import ConfigError
from fitctl.logging.reading import log_info
from fitctl.messages.modes import Mode
from fitctl.report.quick import as_figure, as_text, read_series

_PICTURES = {".png", ".svg", ".pdf"}


def plot(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="LOG TOPIC...",
            help="An MCAP file (not with --latest), then topics or fields such as "
            "/fit/right/tick.error_az_px or error_az_px; * is anything.",
        ),
    ],
    from_: Annotated[
        str | None,
        typer.Option("--from", metavar="TIME", help="Seconds after LOG's start, or UTC."),
    ] = None,
    to: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="End of the plot, in the same form.")
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(metavar="MODE", help="Only while the loop is in this mode, such as VERNIER."),
    ] = None,
    ylim: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Range of the vertical axis."),
    ] = None,
    window: Annotated[bool, typer.Option("--window", help="Open a window instead.")] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture to write instead: PNG, SVG or PDF.")
    ] = None,
    latest: LatestOption = False,
    rig: RigOption = None,
) -> None:
    """Plot fields of a log in the terminal.

    Draws one panel for each unit.
    """
    if out is not None and out.suffix.lower() not in _PICTURES:
        msg = f"plot: --out {out}: expected a name that ends in {', '.join(sorted(_PICTURES))}"
        raise ConfigError(msg)
    named, what = ([], words) if latest else ([Path(words[0])], words[1:])
    if not what:
        msg = "plot: expected a topic or a field after the log, such as error_az_px"
        raise ConfigError(msg)
    log = logs_alone("plot", named, rig, latest=latest)[-1]
    found = log_info(log)
    if not found.counts:
        msg = f"plot: {log} has no record, so there is nothing to plot; name another log"
        raise ConfigError(msg)
    # What waited for the recorder is older than the log's start.
    from_ns = 0 if from_ is None else time_ns("--from", from_, found)
    to_ns = 2**63 - 1 if to is None else time_ns("--to", to, found)
    if to_ns <= from_ns:
        begin = f"--from {from_}" if from_ else "the first record"
        end = "the last record" if to is None else f"--to {to}"
        msg = f"plot: {end} is not after {begin}"
        raise ConfigError(f"{msg}; choose a later --to, or an earlier --from")
    series = read_series(log, what, from_ns, to_ns, None if mode is None else _mode(mode))
    if not any(len(one.time_s) for one in series):
        in_mode = "" if mode is None else f" in mode {mode.upper()}"
        msg = (
            f"plot: {log} has no values of {', '.join(what)}{in_mode} between --from "
            f"{from_ or 'its start'} and --to {to or 'its end'}"
        )
        raise ConfigError(msg)
    for one in series:
        if one.beyond:
            say(
                f"{log}: {one.beyond} values of {one.label} are infinite or too large to draw",
                err=True,
            )
    if ylim is not None and not 0 < ylim[1] - ylim[0] < math.inf:
        msg = (
            f"plot: --ylim {ylim[0]:g} {ylim[1]:g}: the first must be below the second, and their difference "
            "finite"
        )
        raise ConfigError(msg)
    if out is None and not window:
        print(as_text(log, series, ylim, colours=sys.stdout.isatty()))
        return
    figure = as_figure(log, series, ylim)
    if out is not None:
        _save(figure, out)
    if window:
        _show(figure)


def _mode(text: str) -> Mode:
    try:
        return Mode[text.upper()]
    except KeyError:
        msg = f"plot: --mode {text}: unknown mode; available: {', '.join(Mode.__members__)}"
        raise ConfigError(msg) from None


def _save(figure: Any, out: Path) -> None:
    try:
        figure.savefig(out)
    except OSError as error:
        msg = f"plot: --out {out}: cannot be written: {error.strerror or error}; name another file"
        raise ConfigError(msg) from None
    say(f"written: {out}")


def _show(figure: Any) -> None:
    from matplotlib import pyplot

    manager = pyplot.figure().canvas.manager
    if manager is None or manager.canvas.required_interactive_framework is None:
        say(
            "plot: no window can be opened: matplotlib finds no display, or no toolkit such as python3-tk; "
            "leave --window away, or name a picture with --out",
            err=True,
        )
        raise typer.Exit(FAILED)
    manager.canvas.figure = figure
    figure.set_canvas(manager.canvas)
    pyplot.show()
