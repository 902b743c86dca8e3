"""`fitctl demo`: the whole instrument on mock devices, with a console or with a summary at the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from fitctl import demo as demos
from fitctl.commands.exits import FAILED
from fitctl.commands.printing import progress_line, to_json
from fitctl.config import Rig
from fitctl.messages.telemetry import Telemetry
from fitctl.processes import (
    end_process,
    ended_by_signals,
    interrupt,
    rig_arguments,
    show_process,
)

_CONSOLE_END_S = 3.0


def run_demo(
    rig: Rig,
    rig_path: Path,
    overrides: Sequence[str],
    seed: int,
    duration_s: float,
    *,
    console: bool,
    as_json: bool,
) -> int:
    """Run the demo; returns the exit status."""
    rig.mock_parts()
    with ended_by_signals(interrupt):
        try:
            with demos.instrument(rig_path, overrides, seed) as running:
                if console:
                    return _demo_with_console(rig_path, overrides, running)
                return _demo_headless(rig, running, duration_s, as_json=as_json)
        except (demos.DemoError, ConnectionError) as error:
            typer.echo(f"demo: {error}", err=True)
            return FAILED


def _demo_with_console(rig_path: Path, overrides: Sequence[str], running: demos.Instrument) -> int:
    thread = demos.acquire_in_background(running)
    # A process of its own: when its terminal goes away it may hang, and must not hang us with it.
    console = show_process(
        [
            "console",
            *rig_arguments(rig_path, [*overrides, f"service.folder={running.sockets}"]),
            "--quitting-ends-instrument",
        ]
    )
    try:
        console.wait()
    finally:
        end_process(console, _CONSOLE_END_S)
    thread.join(timeout=5.0)
    newest = demos.newest_telemetry(running.sockets)
    if newest is not None and newest.recorder is not None:
        typer.echo(f"log: {newest.recorder.path}")
    return 0 if console.returncode == 0 else FAILED


def _demo_headless(rig: Rig, running: demos.Instrument, duration_s: float, *, as_json: bool) -> int:
    demos.acquire(running)
    with progress_line() as progress:
        task = progress.add_task("starting", total=duration_s)

        def show(gone_s: float, telemetry: Telemetry) -> None:
            progress.update(task, completed=gone_s, description=_progress_text(telemetry))

        course = demos.watch(running, duration_s, show)
    results = {name: demos.summary(rig, running, course, name) for name in rig.loops}
    if as_json:
        # One loop: its summary. Several: one for each, by name.
        typer.echo(to_json(next(iter(results.values())) if len(results) == 1 else results))
    else:
        for name, result in results.items():
            typer.echo(_summary_text(name, result))
    held = all(result["judged_s"] > 0 for result in results.values())
    return 0 if held else FAILED


def _progress_text(telemetry: Telemetry) -> str:
    parts = []
    for loop in telemetry.loops:
        ticks = [t for t in telemetry.ticks if t.loop == loop.name and t.star_visible]
        error = (
            f" az {ticks[-1].error_az_px:+.3f} el {ticks[-1].error_el_px:+.3f} px" if ticks else ""
        )
        parts.append(f"{loop.name} {loop.mode:<11}{error:<28}")
    return "; ".join(parts)


def _summary_text(name: str, result: dict[str, Any]) -> str:
    rms, measured, arcsec = result["rms_px"], result["measured_rms_px"], result["rms_arcsec"]
    lines = [
        f"loop {name}",
        f"  star found after     {result['acquired_s']:8.1f} s",
        f"  vernier after        {result['vernier_s']:8.1f} s",
        f"  true residual RMS    az {rms['az']:.4f} px, el {rms['el']:.4f} px"
        f" (az {arcsec['az']:.3f}, el {arcsec['el']:.3f} arcsec on the sky)"
        f" over the last {result['judged_s']:.0f} s",
        f"  measured RMS         az {measured['az']:.4f} px, el {measured['el']:.4f} px",
        f"  frames               {result['frames']} ({result['frames_lost']} lost),"
        f" {result['late_ticks']} late ticks, {result['records_lost']} records lost",
        f"  log                  {result['log']}",
    ]
    if result["machine_stalls"]:
        lines.insert(
            -1,
            f"  this machine stalled {result['machine_stalls']} times,"
            f" {result['worst_stall_s'] * 1e3:.0f} ms at worst",
        )
    return "\n".join(lines)
