"""What is not well with an instrument, read off one telemetry message: for shells, metrics and the console.

Each cause is named once, however many loops, interlocks and devices report it; and no reset is asked for that
another command makes needless.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

from fitctl.logging.records import HEXAPOD, DeviceHealth
from fitctl.messages.modes import OPERATOR, Mode
from fitctl.messages.telemetry import LoopState, Telemetry, TrippedInterlock

FIND_STAR = "check shutter and clouds; release, stop or acquire ends the search"
RECORDER_SILENT_S = 10.0  # it reports about once a second

_DID = {
    "warn": "nothing was changed",
    "freeze": "the stages wait where they are",
    "flatten": "the mirror goes to its bias, the siderostat waits",
    "safe": "the loop went to SAFE",
}
_AFTER_FAILURE = {
    "standby": "all devices were closed again",
    "recover": "all devices were closed again",
    "acquire": "the siderostat waits where it is",
    "search": "the siderostat waits where it is",
    "controller": "the previous design stays in force",
    "off": "the loop is OFF",
}
# A quantity out of range, and those whose trips explain it: the warning about it names no cause of its own.
_EXPLAINED_BY = {
    "tick_period_fraction": {"dac_round_trip_s"},
    "star_flux_fraction": {"frame_late_s"},
    "following_error_rad": {"siderostat_rate_fraction", "amplifier_fault"},
}
_POWERS_UP = {Mode.SAFE.name: "recover", Mode.OFF.name: "standby"}  # and resets every interlock


class Trouble(NamedTuple):
    """One thing that an operator should look at.

    Attributes
    ----------
    key : str
        Its cause: from one message to the next an alarm stays the same one, whatever reports it.
    severity : str
        A "note" makes an instrument not well, and is no alarm: somebody wanted it so.
    what, did, todo : str
        What is wrong, what the system did about it, and what to do. The last two may be empty.
    since_s : float
    loops : tuple of str
        Which loops, where `what` does not say that.
    is_safe : bool
        They are SAFE.
    number : int
        Grows with new trouble of the same cause: records lost, or the time in ms of a failed command.
    latches : bool
        An operator should know of it also when it is over.
    """

    key: str
    severity: Literal["note", "warning", "error"]
    what: str
    since_s: float
    did: str = ""
    todo: str = ""
    loops: tuple[str, ...] = ()
    is_safe: bool = False
    number: int = 0
    latches: bool = True

    @property
    def line(self) -> str:
        """All of it, as `fitctl status` prints it; a warning changed nothing."""
        safe = f" {'is' if len(self.loops) == 1 else 'are'} SAFE" if self.is_safe else ""
        head = f"{', '.join(self.loops)}{safe}: " if self.loops else ""
        did = self.did if self.severity == "error" else ""
        return head + "; ".join(filter(None, (self.what, did, self.todo)))


def troubles(telemetry: Telemetry) -> list[Trouble]:
    """What an operator should look at; empty where all is well.

    A loop that is SAFE or searches for the star that it lost, a command that failed, an interlock that is
    tripped, a device in fault, a recorder that says nothing, records that are missing from the log.
    """
    found: dict[str, Trouble] = {}
    for loop in telemetry.loops:
        for trouble in _of_loop(loop, telemetry.time_s):
            known = found.get(trouble.key)
            found[trouble.key] = trouble if known is None else _merged(known, trouble)
    for device in telemetry.devices:
        # What a device reported before the last change of its loops' modes is of the past.
        changed_s = max((loop.since_s for loop in _served(telemetry, device)), default=0.0)
        is_now = device.state == "fault" and device.time_s >= changed_s
        if is_now and not any(_is_of(device, cause) for cause in found):
            trouble = _of_device(telemetry, device)
            found[trouble.key] = trouble
    return [*found.values(), *_of_recording(telemetry)]


def _merged(one: Trouble, other: Trouble) -> Trouble:
    """The same cause, reported by two loops."""
    since_s = min(one.since_s, other.since_s)
    return one._replace(since_s=since_s, loops=(*one.loops, *other.loops))


def _of_loop(loop: LoopState, now_s: float) -> Iterator[Trouble]:
    """Troubles of a loop, one for each cause: the first that names it says most."""
    named = set()
    for trouble in (
        *_of_failure(loop),
        *_of_safe(loop),
        *_of_search(loop, now_s),
        *_of_interlocks(loop),
    ):
        if trouble.key not in named:
            named.add(trouble.key)
            yield trouble


def _of_failure(loop: LoopState) -> Iterator[Trouble]:
    failure, change = loop.last_failure, loop.last_change
    if failure is None:
        return
    is_safe = loop.mode == Mode.SAFE.name
    if is_safe and change is not None and change.reason == failure.text:
        return  # the loop's own fault ended the command
    what, todo = _parted(failure.text)
    yield Trouble(
        _cause(failure.text),
        "error",
        f"{failure.what} failed: {what}",
        failure.time_s,
        _AFTER_FAILURE.get(failure.what, ""),
        _after_failure(loop, failure.what, todo),
        (loop.name,),
        is_safe=is_safe,
        number=round(1e3 * failure.time_s) if math.isfinite(failure.time_s) else 0,
    )


def _of_safe(loop: LoopState) -> Iterator[Trouble]:
    if loop.mode != Mode.SAFE.name:
        return
    change = loop.last_change
    reason = loop.why
    fault = change is not None and change.trigger == "FAULT"
    if not fault and loop.last_failure is not None:
        return  # a stop ended a command, whose failure says so
    what, todo = _parted(reason)
    if reason == OPERATOR:
        what, todo = "stopped by the operator", "recover, or off"
    yield Trouble(
        _cause(reason) if fault else f"{loop.name} SAFE",
        "error" if fault else "note",
        what,
        loop.since_s,
        "",
        _then(todo, "recover") if fault else todo,
        (loop.name,),
        is_safe=True,
    )


def _of_search(loop: LoopState, now_s: float) -> Iterator[Trouble]:
    search = loop.search_again
    if search is None:
        return
    what, did = _parted(search_again_text(loop, now_s))
    yield Trouble(
        f"{loop.name} star",
        "error",
        what,
        search.since_s,
        did,
        FIND_STAR,
        (loop.name,),
        latches=False,
    )


def _of_interlocks(loop: LoopState) -> Iterator[Trouble]:
    for trip in _alarming_interlocks(loop):
        what, todo = _parted(trip.reason)
        yield Trouble(
            _cause(trip.reason),
            "warning" if trip.action == "warn" else "error",
            what,
            trip.since_s,
            _DID[trip.action],
            _with_reset(loop, trip, todo),
        )


def _alarming_interlocks(loop: LoopState) -> list[TrippedInterlock]:
    """Tripped interlocks, without warnings of what is over in this mode or what another one explains."""
    rows = {row.name: row for row in loop.watched}
    tripped = {rows[trip.name].quantity for trip in loop.interlocks if trip.name in rows}
    shown = []
    for trip in loop.interlocks:
        row = rows.get(trip.name)
        if trip.action == "warn" and row is not None:
            resets_later = trip.reset == "itself" and not row.judged
            explained = _EXPLAINED_BY.get(row.quantity, set()) & tripped
            is_star = row.quantity == "star_flux_fraction" and loop.search_again is not None
            if resets_later or explained or is_star:
                continue
        shown.append(trip)
    return shown


def _with_reset(loop: LoopState, trip: TrippedInterlock, todo: str) -> str:
    """What to do, and what resets the interlock, if anybody must."""
    powers_up = _POWERS_UP.get(loop.mode)
    if trip.action == "safe" and powers_up:
        return _then(todo, powers_up)
    if trip.reset == "itself":
        return todo
    by = f"{powers_up} resets it" if powers_up else f"then reset {trip.name}"
    return "; ".join(filter(None, (todo, by)))


def _after_failure(loop: LoopState, what: str, todo: str) -> str:
    """What to do, ending with the command with which to go on."""
    match what:
        case "standby" | "recover":
            return _then(todo, _POWERS_UP.get(loop.mode, what))
        case "acquire" | "search":
            return _then(todo, "acquire again")
        case "off":
            return todo or "look at the device; cut its power if it may still move"
        case _:
            return todo or "correct the loop's values in the rig file, or choose another design"


def _then(todo: str, command: str) -> str:
    """What to do, ending with a command."""
    what = todo.removesuffix(", then recover")
    if command in what:
        return what
    if not what:
        return f"remove its cause, then {command}"
    many = ";" in what or what.endswith("?")
    return f"{what}{';' if many else ','} then {command}"


def search_again_text(loop: LoopState, now_s: float) -> str:
    """Since when the star is lost, and how far the search goes; empty if the loop does not search again."""
    search = loop.search_again
    if search is None:
        return ""
    return (
        f"star lost {now_s - search.since_s:.0f} s ago; the loop searches again, round {search.round_number}, "
        f"within {search.radius_sky_arcsec:.0f} arcsec of its last place"
    )


def _is_of(device: DeviceHealth, cause: str) -> bool:
    """Whether a cause is what a device reports, or another error of the same device."""
    is_device = not cause.startswith("interlock ")
    return cause == _cause(device.detail) or (
        is_device and cause.endswith(f" at {device.endpoint}")
    )


def _served(telemetry: Telemetry, device: DeviceHealth) -> list[LoopState]:
    """The loops that need a device: its own, all for the camera, none for the hexapod."""
    own = [loop for loop in telemetry.loops if device.device.startswith(f"{loop.name} ")]
    return own or ([] if device.device == HEXAPOD else list(telemetry.loops))


def _of_device(telemetry: Telemetry, device: DeviceHealth) -> Trouble:
    what, todo = _parted(device.detail)
    served = _served(telemetry, device)
    is_safe = any(loop.mode == Mode.SAFE.name for loop in served)
    did = "fitctl tries again" if served else "the collector's motion has ended"
    # An error that names its device has the same cause when the loop goes to SAFE a message later.
    named = f" at {device.endpoint}: " in what
    return Trouble(
        _cause(what) if named else device.device,
        "error",
        what if named else f"{device.device} at {device.endpoint}: {what}",
        device.time_s,
        "the loop is in SAFE" if is_safe else did,
        _then(todo, "recover") if is_safe else todo,
    )


def _of_recording(telemetry: Telemetry) -> Iterator[Trouble]:
    recorder, lost = telemetry.recorder, telemetry.records_lost
    go_on = "the loop goes on"
    heard_s = telemetry.recorder_started_s if recorder is None else recorder.time_s
    if heard_s is None:
        yield Trouble(
            "recorder",
            "warning",
            "nothing is being recorded",
            telemetry.time_s,
            f"{go_on}, the supervisor tries again",
            "see the events: disk full, or logging.folder?",
        )
    elif (silent_s := telemetry.time_s - heard_s) > RECORDER_SILENT_S:
        yield Trouble(
            "recorder",
            "warning",
            f"nothing is being recorded: the recorder has been silent for {silent_s:.0f} s",
            heard_s,
            f"{go_on}, records wait for it",
            "see the events, and the disk of logging.folder",
        )
    if lost:
        yield Trouble(
            "records",
            "warning",
            f"{lost:,} records are missing from the log of this run".replace(",", " "),
            telemetry.time_s,
            f"{go_on}; the gap is counted in the log",
            "see the events for the reason",
            number=lost,
        )


def _cause(reason: str) -> str:
    """What a text names as the cause: an interlock on a part of the rig, a device, or all that happened."""
    what, _ = _parted(reason)
    if what.startswith("interlock "):
        return ": ".join(what.split(": ", 2)[:2])
    device, expected, _ = what.partition(": expected ")
    return device if expected else what


def _parted(reason: str) -> tuple[str, str]:
    """What happened, and the next step, which follows in such texts."""
    what, _, todo = reason.partition("; ")
    return what, todo
