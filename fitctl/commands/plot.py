"""`fitctl plot`: fields of a log at a glance."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import typer

from fitctl.commands.exits import FAILED
from fitctl.commands.log import one_line, time_ns
from fitctl.config import ConfigError
from fitctl.logging.reading import log_info
from fitctl.report.quick import Series, as_figure, as_text, read_series

_PICTURES = {".png", ".svg", ".pdf"}


def run_plot(
    log: Path, what: Sequence[str], span: tuple[str, str | None], *, window: bool, out: Path | None
) -> int:
    """Draw; returns the exit status."""
    if out is not None and out.suffix.lower() not in _PICTURES:
        msg = f"plot: --out {out}: expected a name that ends in {', '.join(sorted(_PICTURES))}"
        raise ConfigError(msg)
    with one_line():
        found = log_info(log)
        from_ns = time_ns("--from", span[0], found) if found.counts else 0
        to_ns = 2**63 - 1 if span[1] is None else time_ns("--to", span[1], found)
        series = read_series(log, what, from_ns, to_ns)
    if not any(len(one.time_s) for one in series):
        msg = f"plot: {log} has nothing of that between --from {span[0]} and --to {span[1] or 'its end'}"
        raise ConfigError(msg)
    if out is not None:
        return _picture(log, series, out)
    if window:
        return _window(log, series)
    typer.echo(as_text(log, series, colours=sys.stdout.isatty()))
    return 0


def _picture(log: Path, series: Sequence[Series], out: Path) -> int:
    try:
        as_figure(log, series).savefig(out)
    except OSError as error:
        msg = f"plot: --out {out}: cannot be written: {error.strerror or error}; name another file"
        raise ConfigError(msg) from None
    typer.echo(f"written: {out}")
    return 0


def _window(log: Path, series: Sequence[Series]) -> int:
    from matplotlib import pyplot

    manager = pyplot.figure().canvas.manager
    if manager is None or manager.canvas.required_interactive_framework is None:
        typer.echo(
            "plot: no window can be opened: matplotlib finds no display, or no toolkit such as python3-tk; "
            "leave --window away, or name a picture with --out",
            err=True,
        )
        return FAILED
    figure = as_figure(log, series)
    manager.canvas.figure = figure
    figure.set_canvas(manager.canvas)
    pyplot.show()
    return 0
