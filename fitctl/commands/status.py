"""`fitctl status`: one look at a running instrument, for people and for scripts."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import msgspec
import typer

from fitctl.commands.printing import to_json
from fitctl.messages.client import REPLY_TIMEOUT_S, Client
from fitctl.messages.commands import Status
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.troubles import troubles

WELL = 0
NOT_WELL = 1
NO_SUPERVISOR = 3
_STREAMS = ("frame", "events", "mode_changes")  # `fitctl watch` and the log have them


def run_status(client: Client, *, as_json: bool) -> int:
    """Print how the instrument is; returns the exit status: `WELL`, `NOT_WELL` or `NO_SUPERVISOR`."""
    try:
        telemetry = newest_telemetry(client)
    except ConnectionError as error:
        typer.echo(f"status: {error}", err=True)
        return NO_SUPERVISOR
    finally:
        client.close()
    found = troubles(telemetry)
    if as_json:
        typer.echo(to_json(status_document(telemetry, found)))
    else:
        typer.echo("\n".join(status_lines(telemetry, found)))
    return NOT_WELL if found else WELL


def newest_telemetry(client: Client) -> Telemetry:
    """One message.

    Raises
    ------
    ConnectionError
        If nobody answers, or no telemetry comes.
    """
    client.send(Status())  # who is not there is told sooner, and by name
    telemetry = client.receive(REPLY_TIMEOUT_S)
    if telemetry is None:
        msg = f"the supervisor answers, but sends no telemetry ({REPLY_TIMEOUT_S:g} s); see its output"
        raise ConnectionError(msg)
    return telemetry


def utc(telemetry: Telemetry, time_s: float) -> str:
    """A time of the supervisor's clock as ISO 8601."""
    wall_s = time_s + telemetry.wall_minus_monotonic_s
    return datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="milliseconds")


def status_document(telemetry: Telemetry, found: list[str]) -> dict[str, Any]:
    """One telemetry message as plain values, judged: without its streams, with each loop's newest tick."""
    told = msgspec.to_builtins(telemetry)
    for stream in _STREAMS:
        del told[stream]
    told["ticks"] = list({tick["loop"]: tick for tick in told["ticks"]}.values())
    for loop in told["loops"]:
        loop["since"] = utc(telemetry, loop["since_s"])
    verdict = {"well": not found, "troubles": found, "time": utc(telemetry, telemetry.time_s)}
    return verdict | told


def status_lines(telemetry: Telemetry, found: list[str]) -> list[str]:
    """The same for people."""
    lines = [f"{telemetry.rig_name}: {'not well' if found else 'well'}"]
    lines += [f"  ! {trouble}" for trouble in found]
    for loop in telemetry.loops:
        for_s = duration(telemetry.time_s - loop.since_s)
        lines.append(_line(loop.name, f"{loop.mode} for {for_s}, controller {loop.controller}"))
    for device in telemetry.devices:
        known = f" ({device.identity})" if device.identity else ""
        told = f"{device.state}{known} at {device.endpoint}, {device.detail}"
        lines.append(_line(device.device, told))
    for timing in telemetry.timing:
        told = (
            f"{timing.ticks} ticks, {timing.late_ticks} late, computed in "
            f"{timing.compute_worst_s * 1e3:.1f} ms at worst, {timing.stalls} stalls of the machine"
        )
        lines.append(_line(f"{timing.loop} last second", told))
    if telemetry.recorder is not None:
        told = f"{telemetry.recorder.path}, {telemetry.recorder.records} records"
        lines.append(_line("log", f"{told}, {telemetry.records_lost} lost"))
    unsent = ", ".join(f"{count} {name}" for name, count in telemetry.losses.unsent.items())
    lines.append(_line("unsent", unsent.replace("_", " ")))
    running = telemetry.running_sequence
    if running is not None:
        told = f"{running.name} {running.state}, step {running.step_number} of {running.steps}"
        lines.append(_line("sequence", f"{told} ({running.step})"))
    lines.append(_line("commander", telemetry.commander or "nobody"))
    lines.append(_line("supervisor", f"process {telemetry.pid}, {telemetry.scheduling}"))
    return lines


def _line(what: str, told: str) -> str:
    return f"  {what:<17}  {told}"


def duration(seconds: float) -> str:
    """A time span for people: its two largest units."""
    whole = int(max(0.0, seconds))
    parts = [
        (whole // 86400, "d"),
        (whole // 3600 % 24, "h"),
        (whole // 60 % 60, "min"),
        (whole % 60, "s"),
    ]
    first = next((n for n, (count, _) in enumerate(parts) if count), len(parts) - 1)
    return " ".join(f"{count} {unit}" for count, unit in parts[first : first + 2])
