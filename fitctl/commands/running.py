"""Command lines of what runs an instrument: the demo, mock devices, the supervisor and what it starts."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.choosing import client_of, rig_of, with_controller
from fitctl.commands.options import (
    ControllerOption,
    JsonOption,
    ParentOption,
    RigOption,
    SeedOption,
    SetOption,
)
from fitctl.config import default_rig_path


def demo(
    rig: RigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, help="Seconds to run without a console.")
    ] = 60.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="No console, also on a terminal.")
    ] = False,
    as_json: JsonOption = False,
    controller: ControllerOption = None,
) -> None:
    """Run the whole instrument on mock devices: see a star acquired and held.

    On a terminal the console comes up. Without one, or with --headless, the same runs for a while and
    a summary is printed at the end.
    """
    from fitctl.commands.demo import run_demo

    overrides = with_controller(rig, overrides, controller)
    settings = rig_of(rig, overrides)
    console = not (headless or as_json) and sys.stdin.isatty() and sys.stdout.isatty()
    arguments = (rig or default_rig_path(), overrides, seed)
    raise typer.Exit(run_demo(settings, *arguments, duration, console=console, as_json=as_json))


def mocks(
    rig: RigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
    free_ports: Annotated[
        bool, typer.Option("--free-ports", help="Take any free port for every device.")
    ] = False,
    faults: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="What goes wrong and when: a TOML file of [[fault]] tables."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="What the camera shows: a log's frames, in place of the mock star."
        ),
    ] = None,
    parent_pid: ParentOption = None,
) -> None:
    """Serve the rig's mock devices on 127.0.0.1 until Ctrl-C, and print where they listen."""
    from fitctl.commands.fault import with_script
    from fitctl.commands.mocks import run_mocks

    settings = rig_of(rig, overrides)
    if faults is not None:
        settings = with_script(settings, faults)
    run_mocks(settings, seed, camera, as_json=as_json, free_ports=free_ports, parent_pid=parent_pid)


def run(
    rig: RigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    parent_pid: ParentOption = None,
) -> None:
    """Supervise the rig until Ctrl-C or a shutdown command; attach with `fitctl console`."""
    from fitctl.daemon.run import run_supervisor
    from fitctl.processes import end_with_parent, rig_arguments
    from fitctl.stages.realtime import bound_memory

    bound_memory()
    overrides = with_controller(rig, overrides, controller)
    settings = rig_of(rig, overrides)
    end_with_parent(parent_pid)
    run_supervisor(
        settings,
        rig_arguments(rig or default_rig_path(), overrides),
        lambda folder: print(f"supervising {settings.name}; sockets in {folder}", flush=True),
    )


def record(
    rig: RigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Record what a supervisor sends; the supervisor starts this by itself."""
    from fitctl.commands.record import run_recorder

    run_recorder(rig_of(rig, overrides), parent_pid=parent_pid)


def metrics(
    rig: RigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Serve metrics of the running instrument; the supervisor starts this by itself."""
    from fitctl.processes import end_with_parent, ended_by_signals
    from fitctl.service.metrics import serve_metrics

    settings = rig_of(rig, overrides)
    end_with_parent(parent_pid)
    stop = threading.Event()
    client = client_of(settings)
    try:
        with ended_by_signals(stop.set):
            serve_metrics(client, settings.service.metrics_port, settings.name, stop)
    finally:
        client.close()


def gateway(
    rig: RigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Let keys in by TCP; the supervisor starts this by itself."""
    from fitctl.clock import MonotonicClock
    from fitctl.messages.endpoints import service_folder
    from fitctl.processes import end_with_parent, ended_by_signals
    from fitctl.service.gateway import Gateway, be_modest, show_life

    settings = rig_of(rig, overrides)
    be_modest()
    end_with_parent(parent_pid)
    stop = threading.Event()
    with ended_by_signals(stop.set):
        Gateway(settings, service_folder(settings), MonotonicClock(), show_life).run(stop)
