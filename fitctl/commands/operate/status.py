"""`fitctl status`: one look at a running instrument, for people and for scripts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import typer

from fitctl.commands.shared.exits import NO_SUPERVISOR
from fitctl.commands.shared.options import JsonOption, RemoteOption, RigOption, SetOption
from fitctl.commands.shared.printing import say, say_lines, to_json, utc
from fitctl.commands.shared.supervisor import connect
from fitctl.messages.client import REPLY_TIMEOUT_S, Client
from fitctl.messages.commands import Status
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.troubles import troubles

NOT_WELL = 1
_STREAMS = ("frame", "events", "mode_changes")  # `fitctl watch` and the log have them


def status(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the state of the instrument.

    Exit status 0 if all is well, 1 if there is trouble, 3 if no supervisor answers.
    """
    client = connect("status", rig, overrides, remote)
    try:
        telemetry = newest_telemetry(client)
    except ConnectionError as error:
        say(f"status: {error}", err=True)
        raise typer.Exit(NO_SUPERVISOR) from None
    finally:
        client.close()
    found = [trouble.line for trouble in troubles(telemetry)]
    if as_json:
        say(to_json(status_document(telemetry, found)))
    else:
        say_lines("\n".join(status_lines(telemetry, found)))
    raise typer.Exit(NOT_WELL if found else 0)


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


def status_document(telemetry: Telemetry, found: list[str]) -> dict[str, Any]:
    """One telemetry message as plain values, and `found` troubles: no streams, each loop's newest tick."""
    plain = msgspec.to_builtins(telemetry)
    for stream in _STREAMS:
        del plain[stream]
    for key in ("ticks", "metrology_ticks", "overlaps"):
        plain[key] = list({record["loop"]: record for record in plain[key]}.values())
    for loop in plain["loops"]:
        loop["since"] = utc(telemetry, loop["since_s"])
    verdict = {"well": not found, "troubles": found, "time": utc(telemetry, telemetry.time_s)}
    return verdict | plain


def status_lines(telemetry: Telemetry, found: list[str]) -> list[str]:
    """The same for people."""
    rows = list(_rows(telemetry))
    columns = max(len(what) for what, _ in rows)
    return [
        f"{telemetry.rig_name}: {'not well' if found else 'well'}",
        *(f"  ! {trouble}" for trouble in found),
        *(f"  {what:<{columns}}  {text}" for what, text in rows),
    ]


def _rows(telemetry: Telemetry) -> Iterator[tuple[str, str]]:
    """What each line is about, and what it says."""
    for loop in telemetry.loops:
        text = f"{loop.mode} for {duration(telemetry.time_s - loop.since_s)}"
        text += f", controller {loop.controller}" if loop.controller else ""
        text += f", waits for {loop.waits_for}" if loop.waits_for else ""
        yield loop.name, text + _beam(telemetry, loop.name)
    if telemetry.overlaps and not math.isnan(telemetry.overlaps[-1].visibility):
        overlap = telemetry.overlaps[-1]
        tilt = f"{overlap.tilt_az_arcsec:+.3f} {overlap.tilt_el_arcsec:+.3f} arcsec"
        yield "fringes", f"tilt {tilt}, visibility {overlap.visibility:.3f}"
    for device in telemetry.devices:
        known = f" ({device.identity})" if device.identity else ""
        text = f"{device.state}{known} at {device.endpoint}, {device.detail}"
        yield device.device, text
    for timing in telemetry.timing:
        text = f"{timing.ticks} ticks, {timing.late_ticks} late"
        if not math.isnan(timing.compute_worst_s):  # of no tick
            text += f", computed in {timing.compute_worst_s * 1e3:.1f} ms at worst"
        text += f", {timing.stalls} stalls of the machine"
        yield f"{timing.loop} last second", text
    if telemetry.recorder is not None:
        text = f"{telemetry.recorder.path}, {telemetry.recorder.records} records"
        yield "log", f"{text}, {telemetry.records_lost} lost"
    unsent = telemetry.losses.unsent.items()
    text = ", ".join(f"{count} {name}" for name, count in unsent if count)
    yield "unsent", text.replace("_", " ") or "nothing"
    running = telemetry.running_sequence
    if running is not None:
        text = f"{running.name} {running.state}, step {running.step_number} of {running.steps}"
        yield "sequence", text + (f" ({running.step})" if running.step else "")
    yield "commander", telemetry.commander or "none"
    yield "supervisor", f"process {telemetry.pid}, {telemetry.scheduling}"


def _beam(telemetry: Telemetry, loop_name: str) -> str:
    """How far a metrology loop's beam is from its photodiodes' centre, where it is measured."""
    ticks = [tick for tick in telemetry.metrology_ticks if tick.loop == loop_name]
    if not ticks or math.isnan(ticks[-1].beam_az_arcsec):
        return ""
    return f", beam {ticks[-1].beam_az_arcsec:+.2f} {ticks[-1].beam_el_arcsec:+.2f} arcsec"


def duration(seconds: float) -> str:
    """A time span for people: its two largest units."""
    if not math.isfinite(seconds):
        return "an unknown time"
    whole = int(max(0.0, seconds))
    parts = [
        (whole // 86400, "d"),
        (whole // 3600 % 24, "h"),
        (whole // 60 % 60, "min"),
        (whole % 60, "s"),
    ]
    first = next((n for n, (count, _) in enumerate(parts) if count), len(parts) - 1)
    return " ".join(f"{count} {unit}" for count, unit in parts[first : first + 2])
