"""Alarms: what is wrong, since when, what the system did about it, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fitctl.messages.troubles import Trouble, troubles
from fitctl.tui.state import ConsoleState

BELL_EVERY_S = 10.0


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
    if state.stale:
        yield _no_data(state)
    for trouble in () if state.newest is None else troubles(state.newest):
        if trouble.severity != "note":
            yield _alarm(trouble)


def _alarm(trouble: Trouble) -> Alarm:
    loops = ", ".join(trouble.loops)
    went_safe = trouble.is_safe and not trouble.did  # which names the loops then
    return Alarm(
        trouble.key,
        trouble.severity == "error",
        f"{loops}: {trouble.what}" if loops and not went_safe else trouble.what,
        trouble.since_s,
        f"{loops} went to SAFE" if went_safe else trouble.did,
        trouble.todo,
        count=trouble.number,
        latches=trouble.latches,
    )


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
