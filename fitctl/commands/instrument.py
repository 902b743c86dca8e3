"""Commands about an instrument: running it, attaching to it, looking at its logs."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import typer
import zmq
from numpy.typing import NDArray

from fitctl import demo as demos
from fitctl.commands.progress import progress_line
from fitctl.config import ConfigError, LoopMocks, Rig
from fitctl.logging.errors import LogError
from fitctl.logging.pictures import LoggedPictures
from fitctl.logging.records import Event, RecorderStatus
from fitctl.model.plant_constants import plant_constants
from fitctl.processes import (
    ENDING_SIGNALS,
    end_process,
    end_with_parent,
    ended_by_signals,
    show_process,
)
from fitctl.supervisor import messages
from fitctl.supervisor.client import Client
from fitctl.supervisor.endpoints import RECORDS_SOCKET, service_folder
from fitctl.supervisor.messages import Telemetry

FAILED = 1
_REPORT_TIMEOUT_S = 0.5
Picture = Callable[[float], NDArray[np.uint16]]
_CONSOLE_END_S = 3.0


# ---------------------------------------------------------------- demo


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


def interrupt() -> None:
    """End as Ctrl-C does, letting go of everything."""
    raise KeyboardInterrupt


def _demo_with_console(rig_path: Path, overrides: Sequence[str], running: demos.Instrument) -> int:
    thread = demos.acquire_in_background(running)
    # A process of its own: when its terminal goes away it may hang, and must not hang us with it.
    console = show_process(
        [
            "console",
            "--rig",
            str(rig_path),
            *(part for text in overrides for part in ("--set", text)),
            "--set",
            f"service.folder={running.sockets}",
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
        typer.echo(demos.to_json(next(iter(results.values())) if len(results) == 1 else results))
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


# ---------------------------------------------------------------- processes


def run_mocks(
    rig: Rig,
    seed: int,
    camera_log: Path | None,
    *,
    as_json: bool,
    free_ports: bool,
    parent_pid: int | None,
) -> None:
    """Serve the mock testbed until a signal comes; its camera shows a log's frames, if there is one."""
    from fitctl.mocks.event_loop import run_on_time

    picture = None if camera_log is None else _pictures(rig, camera_log)
    if free_ports:
        rig = _with_free_ports(rig)
    end_with_parent(parent_pid)
    run_on_time(_serve_mocks(rig, seed, picture, as_json=as_json, free_ports=free_ports))


def _pictures(rig: Rig, log: Path) -> Picture:
    camera = rig.true_camera
    try:
        return LoggedPictures(
            log,
            camera.width_px,
            camera.height_px,
            camera.period_s,
            camera.bias_dn,
            lambda why: typer.echo(f"mocks: {why}; it is dark from here on", err=True),
        )
    except LogError as error:
        raise ConfigError(str(error)) from None


def _with_free_ports(rig: Rig) -> Rig:
    _, mocks = rig.mock_parts()
    loops = {name: _loop_with_free_ports(loop) for name, loop in mocks.loops.items()}
    free = mocks.model_copy(update={"gvcp_port": 0, "loops": loops})
    return rig.model_copy(update={"mocks": free})


def _loop_with_free_ports(loop: LoopMocks) -> LoopMocks:
    update: dict[str, Any] = {"slcan_port": 0, "modbus_port": 0, "mdt693_port": 0}
    if loop.ensemble is not None:
        update["ensemble"] = loop.ensemble.model_copy(update={"tcp_port": 0})
    if loop.bal_analog is not None:
        update["bal_analog"] = loop.bal_analog.model_copy(update={"modbus_port": 0})
    return loop.model_copy(update=update)


async def _serve_mocks(
    rig: Rig, seed: int, picture: Picture | None, *, as_json: bool, free_ports: bool
) -> None:
    from fitctl.mocks.faults import UnknownFault
    from fitctl.mocks.testbed import Testbed

    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in ENDING_SIGNALS:
        loop.add_signal_handler(number, ending.set)
    # The bench has its own port where it can: there `fitctl fault` finds the mocks of a demo.
    testbed = Testbed(rig, seed, bench_at_any_port=free_ports, picture=picture)
    try:
        endpoints = await testbed.start()
    except UnknownFault as error:
        await testbed.stop()
        msg = f"mocks: {error}"
        raise ConfigError(msg) from None
    except (OSError, zmq.ZMQError) as error:
        await testbed.stop()
        msg = f"mocks: a port is taken: {error}; choose others with --set, or use --free-ports"
        raise ConfigError(msg) from None
    if as_json:
        print(demos.to_json(endpoints), flush=True)
    else:
        width = max(map(len, endpoints))
        for key, value in endpoints.items():
            print(f"{key:<{width}}  {value}", flush=True)
    await ending.wait()
    await testbed.stop()


def run_rig(rig: Rig, rig_arguments: Sequence[str], *, parent_pid: int | None) -> None:
    """Supervise a rig."""
    from fitctl.supervisor.run import run_supervisor

    end_with_parent(parent_pid)
    run_supervisor(
        rig,
        rig_arguments,
        lambda folder: print(f"supervising {rig.name}; sockets in {folder}", flush=True),
    )


def run_recorder(rig: Rig, *, parent_pid: int | None) -> None:
    """Record until the supervisor ends us, or is gone."""
    from fitctl.logging.recorder import record

    folder = service_folder(rig)
    client = Client(folder)

    def report(status: RecorderStatus) -> None:
        try:
            client.send(messages.RecorderReport(status=status), _REPORT_TIMEOUT_S)
        except ConnectionError:
            return  # no supervisor to tell; the log has it all the same

    stop = threading.Event()
    with ended_by_signals(stop.set):
        try:
            record(
                f"ipc://{folder / RECORDS_SOCKET}",
                rig.logging,
                rig_name=rig.name,
                folder=Path(rig.logging.folder).expanduser(),
                stop=stop,
                on_status=report,
                parent_pid=parent_pid,
            )
        except LogError as error:
            raise ConfigError(str(error)) from None
        finally:
            client.close()


def run_metrics(rig: Rig, *, parent_pid: int | None) -> None:
    """Serve metrics until the supervisor ends us, or is gone."""
    from fitctl.supervisor.metrics import serve_metrics

    end_with_parent(parent_pid)
    stop = threading.Event()
    client = Client(service_folder(rig))
    try:
        with ended_by_signals(stop.set):
            serve_metrics(client, rig.service.metrics_port, rig.name, stop)
    finally:
        client.close()


# ---------------------------------------------------------------- a running instrument


def run_console(
    client: Client,
    arguments: Sequence[str],
    log_folder: Path | None,
    *,
    quitting_ends_instrument: bool,
    graphics: str,
) -> None:
    """Attach a console; other commands that it runs are given `arguments`."""
    from fitctl.tui.app import ConsoleApp
    from fitctl.tui.graphics import Graphics, graphics_of

    app = ConsoleApp(
        client,
        quit_shuts_down=quitting_ends_instrument,
        clock=client.now_s,
        rig_arguments=arguments,
        log_folder=log_folder,
        graphics=graphics_of(Graphics(graphics), os.environ),
    )
    signal.signal(signal.SIGTERM, lambda *_: app.exit())  # leaves the terminal as it was
    app.run()


def send_command(client: Client, command: messages.AnyCommand) -> int:
    """Give one command and print the answer; returns the exit status."""
    try:
        reply = client.send(command)
    except ConnectionError as error:
        typer.echo(f"send: {error}", err=True)
        return FAILED
    finally:
        client.close()
    for event in reply.events:
        typer.echo(_event_line(event, time.time() - reply.time_s))
    answer = reply.text or ("accepted" if reply.accepted else "refused")
    typer.echo(answer, err=not reply.accepted)
    return 0 if reply.accepted else FAILED


def _event_line(event: Event, wall_minus_monotonic_s: float) -> str:
    stamp = datetime.fromtimestamp(event.time_s + wall_minus_monotonic_s, UTC)
    return f"{stamp:%Y-%m-%d %H:%M:%S}  {event.severity}: {event.source}: {event.message}"


# ---------------------------------------------------------------- without an instrument


def check_plant(rig: Rig) -> None:
    """See that the rig's simulated hardware, if it has any, can be.

    Raises
    ------
    ConfigError
        If not.
    """
    if rig.plant is not None:
        for name in rig.loops:
            plant_constants(rig, name, np.zeros((1, 2)))
