"""`fitctl watch`: a line a second and every event, on a terminal, in a pipe or in a file."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Annotated

import msgspec
import typer

from fitctl.commands.shared.exits import NO_SUPERVISOR
from fitctl.commands.shared.options import RemoteOption, RigOption, SetOption
from fitctl.commands.shared.printing import say, to_json, utc
from fitctl.commands.shared.supervisor import connect
from fitctl.logging.records import Severity
from fitctl.messages.modes import Mode
from fitctl.messages.tally import BeamTally, Tally, add_beam_ticks, add_ticks
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.processes import ended_by_signals, interrupt

_LINE_S = 1.0
_POLL_S = 0.2


class LoopSecond(msgspec.Struct, frozen=True, kw_only=True):
    """One loop over a second; what no tick reports is NaN.

    Stars and the mirror are a stellar loop's, the beam is a metrology loop's.
    """

    name: str
    mode: str
    interlocks: list[str]
    rms_az_px: float
    rms_el_px: float
    fsm_range_fraction: float
    search_progress: float
    ticks: int
    late_ticks: int
    star_ticks: int
    beam_samples: int
    rms_az_arcsec: float
    rms_el_arcsec: float
    star_lost: bool
    failed: str


class Second(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="second"):
    """All loops over a second, the last one cut off by the end; ``time`` is its end, ISO 8601."""

    time: str
    rig: str
    loops: list[LoopSecond]


class Happened(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="event"):
    """An event."""

    time: str
    severity: Severity
    source: str
    message: str


class Silence(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="silence"):
    """Nothing came for a second, and why, or what to do."""

    time: str
    message: str


Entry = Second | Happened | Silence


def watch(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object a line, with its `kind`.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(min=0.1, metavar="SECONDS", help="Without it, until Ctrl-C.")
    ] = None,
) -> None:
    """Print a line a second, and every event."""
    client = connect("watch", rig, overrides, remote)

    def why_silent() -> str:
        if remote is None:
            return client.why_silent(_LINE_S)
        # For a remote client, asking takes a second.
        return f"no telemetry comes; to find out why: fitctl status --remote {remote}"

    text = to_json if as_json else _text
    received = False
    try:
        with ended_by_signals(interrupt):
            for entry in entries(client.receive, duration, why_silent):
                received = received or not isinstance(entry, Silence)
                say(text(entry))
    except KeyboardInterrupt:
        pass  # the ordinary end
    except BrokenPipeError:
        # Nobody reads any more; what Python would still flush has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        client.close()
    raise typer.Exit(0 if received else NO_SUPERVISOR)


def entries(
    receive: Callable[[float], Telemetry | None],
    duration_s: float | None,
    why_silent: Callable[[], str],
) -> Iterator[Entry]:
    """What `receive` brings, a second at a time, and every event as it comes; silence once a second.

    Parameters
    ----------
    receive : callable
        Waits at most so many seconds for the next message; ConnectionError for one that cannot be read.
    duration_s : float or None
        By this machine's clock; None goes on for ever.
    why_silent : callable
        Says why nothing comes.
    """
    begun_s = quiet_since_s = time.monotonic()
    due_s = math.inf
    tallies: dict[str, Tally] = {}
    beams: dict[str, BeamTally] = {}
    newest: Telemetry | None = None
    while duration_s is None or time.monotonic() - begun_s < duration_s:
        why = ""
        try:
            telemetry = receive(_POLL_S)
        except ConnectionError as error:
            telemetry, why = None, str(error)
        if telemetry is None:
            if time.monotonic() - quiet_since_s >= _LINE_S:
                quiet_since_s = time.monotonic()
                stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
                yield Silence(time=stamp, message=why or why_silent())
            continue
        quiet_since_s = time.monotonic()
        for event in telemetry.events:
            yield Happened(
                time=utc(telemetry, event.time_s),
                severity=event.severity,
                source=event.source,
                message=event.message,
            )
        add_ticks(tallies, telemetry.ticks)
        add_beam_ticks(beams, telemetry.metrology_ticks)
        if telemetry.time_s >= due_s:
            yield _second(telemetry, tallies, beams)
            tallies, beams = {}, {}
            due_s += _LINE_S * (1 + (telemetry.time_s - due_s) // _LINE_S)
        due_s = min(due_s, telemetry.time_s + _LINE_S)  # a supervisor's clock may have begun anew
        newest = telemetry
    if newest is not None and (tallies or beams):
        yield _second(newest, tallies, beams)


def _second(telemetry: Telemetry, tallies: dict[str, Tally], beams: dict[str, BeamTally]) -> Second:
    return Second(
        time=utc(telemetry, telemetry.time_s),
        rig=telemetry.rig_name,
        loops=[
            _loop(loop, tallies.get(loop.name, Tally()), beams.get(loop.name, BeamTally()))
            for loop in telemetry.loops
        ],
    )


def _loop(loop: LoopState, tally: Tally, beam: BeamTally) -> LoopSecond:
    az_px, el_px = tally.rms_px
    az_arcsec, el_arcsec = beam.rms_arcsec
    stellar, newest = tally.newest, tally.newest or beam.newest
    return LoopSecond(
        name=loop.name,
        mode=loop.mode,
        interlocks=[row.name for row in loop.interlocks],
        rms_az_px=az_px,
        rms_el_px=el_px,
        fsm_range_fraction=math.nan if stellar is None else stellar.fsm_range_fraction,
        search_progress=math.nan if newest is None else newest.search_progress,
        ticks=tally.ticks + beam.ticks,
        late_ticks=tally.late_ticks + beam.late_ticks,
        star_ticks=tally.star_ticks,
        beam_samples=beam.samples,
        rms_az_arcsec=az_arcsec,
        rms_el_arcsec=el_arcsec,
        star_lost=loop.search_again is not None,
        failed="" if loop.last_failure is None else loop.last_failure.what,
    )


def _text(entry: Entry) -> str:
    clock = entry.time[11:19]
    match entry:
        case Second():
            return f"{clock}  {'; '.join(_loop_text(loop) for loop in entry.loops)}"
        case Happened():
            return f"{clock}  {entry.severity}: {entry.source}: {entry.message}"
        case Silence():
            return f"{clock}  {entry.message}"


def _loop_text(loop: LoopSecond) -> str:
    parts = [f"{loop.name} {loop.mode:<11}"]
    if loop.mode == Mode.ACQUISITION.name:
        lost = ", star lost" if loop.star_lost else ""
        parts.append(f"{loop.search_progress:4.0%} searched{lost}")
    elif loop.star_ticks:
        parts.append(f"RMS az {loop.rms_az_px:.4f} el {loop.rms_el_px:.4f} px")
        parts.append(f"mirror {loop.fsm_range_fraction:4.0%}")
    elif loop.beam_samples:
        parts.append(f"RMS az {loop.rms_az_arcsec:.3f} el {loop.rms_el_arcsec:.3f} arcsec")
    if loop.ticks:
        parts.append(f"{loop.ticks} frames, {loop.late_ticks} late")
    if loop.interlocks:
        parts.append(f"tripped: {', '.join(loop.interlocks)}")
    if loop.failed:
        parts.append(f"{loop.failed} failed")
    return "  ".join(parts).rstrip()
