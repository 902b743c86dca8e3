"""Alarms: what is wrong, since when, what the system did about it, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fitctl.logging.records import DeviceHealth, ModeChange
from fitctl.messages.telemetry import LoopState, Telemetry, TrippedInterlock
from fitctl.messages.troubles import FIND_STAR, alarming_interlocks, search_again_text
from fitctl.tui.state import ConsoleState

BELL_EVERY_S = 10.0

_DID = {
    "warn": "nothing was changed",
    "hold": "the stages wait where they are",
    "flatten": "the mirror goes to its bias, the siderostat waits",
    "safe": "the loop went to SAFE",
}


@dataclass
class Alarm:
    """One alarm; `key` tells two apart."""

    key: str
    error: bool
    what: str
    since_s: float
    did: str
    todo: str
    count: int = 0
    latches: bool = True
    over_s: float | None = None
    acknowledged: bool = False
    silenced: bool = False


class AlarmBook:
    """Alarms as an operator has them: new, acknowledged, silenced, over.

    An error that is over stays until it is acknowledged, so that nobody misses what happened while
    nobody looked. A warning goes by itself, and so does a silence of the supervisor.
    """

    def __init__(self) -> None:
        self.alarms: dict[str, Alarm] = {}
        self._rang_s = -BELL_EVERY_S

    def update(self, state: ConsoleState) -> bool:
        """Add what is wrong now, end what is over; true when the bell should ring."""
        newly = False
        wrong = {alarm.key: alarm for alarm in _wrong_now(state)}
        for key, alarm in wrong.items():
            known = self.alarms.get(key)
            if known is None or known.over_s is not None:
                self.alarms[key] = alarm
                newly = True
                continue
            if alarm.count > known.count:
                known.acknowledged = known.silenced = False
                newly = True
            known.what, known.did, known.todo = alarm.what, alarm.did, alarm.todo
            known.count = alarm.count
        for key, alarm in list(self.alarms.items()):
            if key in wrong:
                continue
            if alarm.acknowledged or not alarm.error or not alarm.latches:
                del self.alarms[key]
            elif alarm.over_s is None:
                alarm.over_s = _time_s(state)
        due = newly or state.now_s - self._rang_s >= BELL_EVERY_S
        rings = due and self.loud
        if rings:
            self._rang_s = state.now_s
        return rings

    @property
    def unacknowledged(self) -> bool:
        """There are alarms that were not acknowledged."""
        return any(not alarm.acknowledged for alarm in self.alarms.values())

    @property
    def loud(self) -> bool:
        """The bell rings, now and again."""
        return any(not a.acknowledged and not a.silenced for a in self.alarms.values())

    @property
    def in_order(self) -> list[Alarm]:
        """The weightiest first: not acknowledged, errors, the newest."""
        return sorted(self.alarms.values(), key=lambda a: (a.acknowledged, not a.error, -a.since_s))

    def acknowledge(self) -> None:
        """Acknowledge all of them; what is over goes."""
        for key, alarm in list(self.alarms.items()):
            alarm.acknowledged = True
            if alarm.over_s is not None:
                del self.alarms[key]

    def silence(self) -> None:
        """No bell for these any more; a new one rings again."""
        for alarm in self.alarms.values():
            alarm.silenced = True


def _time_s(state: ConsoleState) -> float:
    """Now, by the supervisor's clock."""
    return state.newest.time_s if state.newest else state.now_s


def _wrong_now(state: ConsoleState) -> Iterator[Alarm]:
    newest = state.newest
    if state.stale:
        yield _no_data(state)
    if newest is None:
        return
    reported = {trip.reason for loop in newest.loops for trip in loop.interlocks}
    for loop in newest.loops:
        yield from (_interlock(loop, trip) for trip in alarming_interlocks(loop))
        if loop.search_again is not None:
            yield _star_lost(loop, loop.search_again.since_s, newest.time_s)
        change = loop.last_change
        if (
            loop.mode == "SAFE"
            and change
            and change.trigger == "FAULT"
            and change.reason not in reported
        ):
            reported.add(change.reason)
            yield _fault(loop, change)
    changed_s = max((loop.since_s for loop in newest.loops), default=0.0)
    for device in newest.devices:
        # What a device reported before the last change of mode is of the past.
        if device.state == "fault" and device.detail not in reported and device.time_s >= changed_s:
            yield _device(newest, device)
    yield from _log(newest)


def _no_data(state: ConsoleState) -> Alarm:
    return Alarm(
        "no data",
        True,
        f"NO DATA for {state.silent_s:.0f} s" + ("; what you see is old" if state.newest else ""),
        state.received_s,
        "the console goes on trying to connect",
        "is the supervisor running? STOP may not reach it: be ready to cut the power",
        latches=False,
    )


def _interlock(loop: LoopState, trip: TrippedInterlock) -> Alarm:
    what, todo = _parted(trip.reason)
    by_hand = f"; then reset {trip.name}" if trip.reset == "hand" else ""
    did = _DID[trip.action]
    error = trip.action != "warn"
    return Alarm(f"{loop.name} {trip.name}", error, what, trip.since_s, did, todo + by_hand)


def _star_lost(loop: LoopState, since_s: float, now_s: float) -> Alarm:
    what, did = _parted(search_again_text(loop, now_s))
    return Alarm(
        f"{loop.name} star", True, f"{loop.name}: {what}", since_s, did, FIND_STAR, latches=False
    )


def _fault(loop: LoopState, change: ModeChange) -> Alarm:
    what, todo = _parted(change.reason)
    did = f"{loop.name} went to SAFE"
    return Alarm(
        f"{loop.name} fault", True, what, change.time_s, did, todo or "mend it, then Recover"
    )


def _device(newest: Telemetry, device: DeviceHealth) -> Alarm:
    what, todo = _parted(device.detail)
    loops = [loop.mode for loop in newest.loops if device.device.startswith(loop.name)]
    modes = loops or [loop.mode for loop in newest.loops]
    did = "the loop is in SAFE" if "SAFE" in modes else "it is asked again"
    return Alarm(
        device.device,
        True,
        f"{device.device}: {what}",
        device.time_s,
        did,
        todo or "see screen Devices, then Recover",
    )


def _log(newest: Telemetry) -> Iterator[Alarm]:
    lost = newest.records_lost
    if lost:
        what = f"{lost:,} records lost from the log".replace(",", " ")
        did = "the loop goes on; the gap is counted in the log"
        todo = "see the events for the reason"
        yield Alarm("records", False, what, newest.time_s, did, todo, count=lost)
    if newest.recorder is None and any(loop.mode != "OFF" for loop in newest.loops):
        did = "the loop goes on, the supervisor tries again"
        todo = "see the events: disk full, or logging.folder?"
        yield Alarm("recorder", False, "nothing is being recorded", newest.time_s, did, todo)


def _parted(reason: str) -> tuple[str, str]:
    """What happened, and the next step, with which such texts end."""
    what, semicolon, todo = reason.rpartition("; ")
    return (what, todo) if semicolon else (reason, "")
