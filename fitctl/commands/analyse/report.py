"""`fitctl report`: a log, as a page."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.logs import LatestOption, chosen_logs, say_left_out, say_unreadable
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import rig_of
from fitctl.config import ConfigError
from fitctl.report.compare import make_comparison
from fitctl.report.findings import Findings, StarFindings, find
from fitctl.report.make import make_report
from fitctl.report.page import SIGNS
from fitctl.report.pdf import PdfError, print_pdf
from fitctl.report.run import find_run
from fitctl.report.tables import interval, number, seconds

MOST_NIGHTS = 6


def report(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="Files of one run, or a folder: its newest run."),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Compare nights side by side; each LOG is one night.")
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also write a PDF; needs Chromium or Chrome.")
    ] = False,
    pdf_without_sandbox: Annotated[
        bool,
        typer.Option(
            "--pdf-without-sandbox", help="As --pdf, also where Chromium has no sandbox (root)."
        ),
    ] = False,
    show: Annotated[bool, typer.Option("--open", help="Open the report in the browser.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder to write. [default: beside the first LOG]"),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Rig file. [default: the one in the log]"),
    ] = None,
    latest: LatestOption = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print the result as one JSON object, as in report.json."),
    ] = False,
) -> None:
    """Make a report of a night: verdict, plots, losses, configuration.

    Writes one self-contained HTML page, every plot as PNG and SVG, and all figures as JSON.
    """
    logs = chosen_logs("report", logs, rig, latest=latest)
    settings = None if rig is None else rig_of(rig, None)
    if compare and not 2 <= len(logs) <= MOST_NIGHTS:
        msg = f"report: --compare takes 2 to {MOST_NIGHTS} logs or folders, got {len(logs)}"
        raise ConfigError(msg)
    runs = [find_run([log], settings) for log in logs] if compare else [find_run(logs, settings)]
    say_unreadable(problem for run in runs for problem in run.unreadable)
    nights = [find(run) for run in runs]
    for night in nights:
        say_left_out(night.gathered)
    name = "comparison" if compare else f"{runs[0].name}_report"
    first = runs[0].logs[0].path
    folder = out or first.with_name(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page = make_comparison(nights, folder) if compare else make_report(nights[0], folder)
    except OSError as error:
        msg = f"report: {folder}: cannot be written: {error.strerror or error}; name another folder with --out"
        raise ConfigError(msg) from None
    if as_json:
        say(to_json(msgspec.json.decode((folder / "report.json").read_bytes())))
    else:
        for night in nights:
            _print_verdict(night)
        say(f"written: {page}")
    if pdf or pdf_without_sandbox:
        try:
            print_pdf(page, page.with_suffix(".pdf"), sandbox=not pdf_without_sandbox)
        except PdfError as error:
            say(f"report: {error}", err=True)
            raise typer.Exit(FAILED) from None
        say(f"written: {page.with_suffix('.pdf')}", err=as_json)
    if show and not webbrowser.open(page.resolve().as_uri()):
        say(f"report: no browser could be opened; open {page} yourself", err=True)
        raise typer.Exit(FAILED)


def _print_verdict(night: Findings) -> None:
    for loop in night.loops.values():
        unit = loop.quantity.unit
        say(
            f"{night.run.name}, loop {loop.name}: {SIGNS[loop.verdict.word]} requirement of "
            f"{loop.requirement:g} {unit} {loop.verdict.word}: {loop.verdict.why}"
        )
        for axis, found in loop.residual.items():
            say(
                f"  {axis} {number(found.rms, '.4f', f'{unit} RMS')}, 95 % interval {interval(found)}"
            )
        if not isinstance(loop, StarFindings):
            continue
        several = len(loop.held_by_controller) > 1
        for held in loop.held_by_controller if several else ():
            rms = ", ".join(
                f"{axis} {number(found.rms, '.4f', 'px RMS')}"
                for axis, found in held.residual.items()
            )
            say(f"  {held.controller}, {seconds(held.evaluated_s)}: {rms}")
        for under in loop.rejections:
            if under.budget is not None:
                say(f"  {under.controller}: {under.budget.verdict}; from {under.budget.parts}")
    if night.fringes is not None:
        figures = night.fringes.figures
        say(
            f"{night.run.name}, fringes of {' and '.join(night.fringes.loops)}: visibility "
            f"{number(figures.visibility_mean, '.3f', 'mean')} over {seconds(figures.judged_s)}"
        )
