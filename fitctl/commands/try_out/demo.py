"""`fitctl demo`: the whole instrument on mock devices, with a console or with a summary at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from fitctl import demo as demos
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import (
    ControllerOption,
    JsonOption,
    SeedOption,
    SetOption,
    ShippedRigOption,
)
from fitctl.commands.shared.printing import progress_line, say, say_lines, to_json
from fitctl.commands.shared.rig import rig_of, with_controller
from fitctl.commands.shared.terminal import has_terminal
from fitctl.config import ConfigError, Rig, default_rig_path
from fitctl.messages.endpoints import service_folder
from fitctl.messages.telemetry import Telemetry
from fitctl.processes import (
    end_process,
    ended_by_signals,
    interrupt,
    rig_arguments,
    show_process,
)

_CONSOLE_END_S = 3.0


def demo(
    rig: ShippedRigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, metavar="SECONDS", help="How long to run without a console.")
    ] = 60.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="Open no console, even on a terminal.")
    ] = False,
    as_json: JsonOption = False,
    controller: ControllerOption = None,
    testbed: Annotated[
        bool,
        typer.Option("--testbed", help="Two stars, metrology and a moving collector."),
    ] = False,
) -> None:
    """Run the whole instrument on mock devices: acquire a star and hold it.

    On a terminal, the demo opens the console. Without a terminal, or with --headless, it runs for --duration
    seconds and prints a summary; its exit status is then 1 if a loop did not reach its star or beam.
    """
    if testbed and rig is not None:
        msg = "demo: --testbed is the rig rigs/fit-testbed.toml; leave out --testbed, or --rig"
        raise ConfigError(msg)
    if testbed:
        rig = default_rig_path().parent / "fit-testbed.toml"
    overrides = with_controller(rig, overrides, controller)
    settings = rig_of(rig, overrides)
    settings.mock_parts()
    path = rig or default_rig_path()
    console = not (headless or as_json) and has_terminal()
    with ended_by_signals(interrupt):
        try:
            with (
                demos.instrument(path, overrides, seed) as running,
                demos.moving_collector(running),
            ):
                beside = _beside(settings, path, running)
                if beside:
                    say(beside, err=True)
                if console:
                    status = _demo_with_console(path, overrides, running)
                    if beside:  # the console was drawn over it
                        say(beside, err=True)
                else:
                    status = _demo_headless(settings, running, duration, as_json=as_json)
        except (demos.DemoError, ConnectionError) as error:
            say(f"demo: {error}", err=True)
            status = FAILED
    raise typer.Exit(status)


def _beside(rig: Rig, path: Path, running: demos.Instrument) -> str:
    """What to say where another demo or supervisor has the rig's sockets; empty if this one has them."""
    usual = service_folder(rig)
    if running.sockets == usual:
        return ""
    return (
        f"demo: another demo or supervisor has rig {rig.name} in {usual}. This demo runs beside it; "
        f"for commands to this one, add: --rig {path} --set service.folder={running.sockets}"
    )


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
    log = demos.log_path(running) or running.log
    say(f"log: {log}" if log else f"no log is known; look in {running.rig.logging.folder}")
    return 0 if console.returncode == 0 else FAILED


def _demo_headless(rig: Rig, running: demos.Instrument, duration_s: float, *, as_json: bool) -> int:
    demos.acquire(running)
    with progress_line("starting", duration_s) as progress:
        course = demos.watch(
            running,
            duration_s,
            lambda gone_s, telemetry: progress(gone_s, _progress_text(telemetry)),
        )
    log = course.log or demos.log_path(running)
    results = {name: demos.summary(rig, running, course, name) | {"log": log} for name in rig.loops}
    visibility = demos.visibility(rig, running, course)
    if as_json:
        # One loop: its summary. Several: one for each, by name, beside what they have in common.
        whole = {"loops": results, "visibility": visibility} | {
            key: max(result[key] for result in results.values())
            for key in (
                *("frames", "frames_lost", "late_ticks", "records_lost"),
                *("machine_stalls", "worst_stall_s"),
            )
        }
        say(to_json(next(iter(results.values())) if len(results) == 1 else whole))
    else:
        for name, result in results.items():
            say_lines(_summary_text(name, result))
        if not math.isnan(visibility):
            say(f"mean visibility of the fringes {visibility:.4f}")
    held = all(result["judged_s"] > 0 for result in results.values())
    return 0 if held else FAILED


def _progress_text(telemetry: Telemetry) -> str:
    parts = []
    for loop in telemetry.loops:
        beams = [t for t in telemetry.metrology_ticks if t.loop == loop.name]
        if beams:
            beam = beams[-1]
            error = f" az {beam.beam_az_arcsec:+.2f} el {beam.beam_el_arcsec:+.2f} arcsec"
            parts.append(f"{loop.name} {loop.mode:<11}{error:<28}")
            continue
        ticks = [t for t in telemetry.ticks if t.loop == loop.name and t.star_visible]
        error = (
            f" az {ticks[-1].error_az_px:+.3f} el {ticks[-1].error_el_px:+.3f} px" if ticks else ""
        )
        parts.append(f"{loop.name} {loop.mode:<11}{error:<28}")
    return "; ".join(parts)


def _summary_text(name: str, result: dict[str, Any]) -> str:
    lines = [
        f"loop {name}",
        *(_star_lines(result) if "rms_px" in result else _beam_lines(result)),
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


def _seconds(time_s: float) -> str:
    return "   never" if math.isnan(time_s) else f"{time_s:8.1f} s"


def _star_lines(result: dict[str, Any]) -> list[str]:
    lines = [
        f"  star found after     {_seconds(result['acquired_s'])}",
        f"  vernier after        {_seconds(result['vernier_s'])}",
    ]
    if not result["judged_s"]:
        return [*lines, "  RMS                  not measured: the star is not held at the end"]
    rms, measured, arcsec = result["rms_px"], result["measured_rms_px"], result["rms_arcsec"]
    return [
        *lines,
        f"  true residual RMS    az {rms['az']:.4f} px, el {rms['el']:.4f} px"
        f" (az {arcsec['az']:.3f}, el {arcsec['el']:.3f} arcsec on the sky)"
        f" over the last {result['judged_s']:.0f} s",
        f"  measured RMS         az {measured['az']:.4f} px, el {measured['el']:.4f} px",
    ]


def _beam_lines(result: dict[str, Any]) -> list[str]:
    lines = [
        f"  beam found after     {_seconds(result['acquired_s'])}",
        f"  locked after         {_seconds(result['locked_s'])}",
    ]
    if not result["judged_s"]:
        return [*lines, "  RMS                  not measured: the beam is not held at the end"]
    arcsec = result["rms_arcsec"]
    return [
        *lines,
        f"  true beam RMS        az {arcsec['az']:.3f} arcsec, el {arcsec['el']:.3f} arcsec"
        f" over the last {result['judged_s']:.0f} s",
    ]
