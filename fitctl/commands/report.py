"""`fitctl report`: what a log tells, as a page."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path

import typer

from fitctl.commands.exits import FAILED
from fitctl.commands.log import one_line
from fitctl.config import ConfigError, Rig
from fitctl.report.compare import make_comparison
from fitctl.report.findings import Findings, find
from fitctl.report.make import make_report
from fitctl.report.page import SIGNS
from fitctl.report.pdf import PdfError, print_pdf
from fitctl.report.run import find_run
from fitctl.report.tables import interval, number

MOST_NIGHTS = 6


def run_report(
    logs: Sequence[Path], rig: Rig | None, out: Path | None, *, compare: bool, show: bool, pdf: bool
) -> int:
    """Make the report of a run, or of several side by side; returns the exit status."""
    if compare and not 2 <= len(logs) <= MOST_NIGHTS:
        msg = f"report: --compare takes 2 to {MOST_NIGHTS} logs or folders, got {len(logs)}"
        raise ConfigError(msg)
    with one_line():
        runs = [find_run([log], rig) for log in logs] if compare else [find_run(logs, rig)]
        nights = [find(run) for run in runs]
    name = "comparison" if compare else f"{runs[0].name}_report"
    first = runs[0].logs[0].path
    folder = out or first.with_name(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page = make_comparison(nights, folder) if compare else make_report(nights[0], folder)
    except OSError as error:
        msg = f"report: {folder}: cannot be written: {error.strerror or error}; name another folder with --out"
        raise ConfigError(msg) from None
    for night in nights:
        _tell(night)
    typer.echo(f"written: {page}")
    if pdf:
        try:
            print_pdf(page, page.with_suffix(".pdf"))
        except PdfError as error:
            typer.echo(f"report: {error}", err=True)
            return FAILED
        typer.echo(f"written: {page.with_suffix('.pdf')}")
    if show and not webbrowser.open(page.resolve().as_uri()):
        typer.echo(f"report: no browser could be opened; open {page} yourself", err=True)
        return FAILED
    return 0


def _tell(night: Findings) -> None:
    for loop in night.loops.values():
        typer.echo(
            f"{night.run.name}, loop {loop.name}: {SIGNS[loop.verdict.word]} requirement of "
            f"{loop.requirement_px:g} px {loop.verdict.word}: {loop.verdict.why}"
        )
        for axis, found in loop.residual.items():
            typer.echo(
                f"  {axis} {number(found.rms_px, '.4f', 'px RMS')}, 95 % interval {interval(found)}"
            )
