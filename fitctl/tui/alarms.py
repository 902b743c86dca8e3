"""Alarms: what is wrong, since when, what the system did about it, and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from fitctl.messages.troubles import Trouble, troubles
from fitctl.tui.state import ConsoleState

BELL_EVERY_S = 10.0
_NO_DATA = "no data"
STOPPED = "stopped by the operator"  # as `troubles` has it, who does not know who it was


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

    def become(self, other: AlarmBook) -> None:
        """Hold what another book holds; panels keep the object that they draw."""
        vars(self).update(vars(other))

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
        """The weightiest first: not acknowledged, that nothing comes any more, errors, the newest."""
        return sorted(
            self.alarms.values(),
            key=lambda a: (a.acknowledged, a.key != _NO_DATA, not a.error, -a.since_s),
        )

    def acknowledge(self, shown: Mapping[str, int]) -> None:
        """Acknowledge the alarms that the operator was shown; of these, what is over goes.

        Parameters
        ----------
        shown : mapping of str to int
            The keys that were on the screen, each with its `count` as it was then: an alarm that has grown
            since is not acknowledged.
        """
        for key, alarm in list(self.alarms.items()):
            if alarm.count > shown.get(key, -1):
                continue
            alarm.acknowledged = True
            if alarm.over_s is not None:
                del self.alarms[key]

    def silence(self) -> None:
        """No bell for these any more; a new one rings again."""
        for alarm in self.alarms.values():
            alarm.silenced = True


def counts(alarms: Iterable[Alarm]) -> dict[str, int]:
    """What :meth:`AlarmBook.acknowledge` needs to know of alarms that are on the screen."""
    return {alarm.key: alarm.count for alarm in alarms}


def notes(state: ConsoleState) -> list[Alarm]:
    """What an operator wanted so and may have forgotten: a loop that was stopped, no recording in OFF.

    They ring no bell, and nobody acknowledges them.
    """
    if state.newest is None or state.stale:
        return []
    found = [trouble for trouble in troubles(state.newest) if trouble.severity == "note"]
    safe = [trouble for trouble in found if trouble.is_safe]
    causes = dict.fromkeys(trouble.what for trouble in safe)
    stops = [_stop(state, [trouble for trouble in safe if trouble.what == what]) for what in causes]
    return stops + [_alarm(trouble) for trouble in found if not trouble.is_safe]


def _stop(state: ConsoleState, stopped: list[Trouble]) -> Alarm:
    """Loops that a person sent to SAFE, together, with the person's name where it is known."""
    alarm, loops = _alarm(stopped[0]), [name for each in stopped for name in each.loops]
    stopped_by = state.newest.stopped_by if state.newest else ""
    if stopped_by and alarm.what == STOPPED:
        alarm.what = f"stopped by {stopped_by}"
    alarm.what, alarm.did = f"{', '.join(loops)} SAFE: {alarm.what}", ""
    return alarm


def _time_s(state: ConsoleState) -> float:
    """Now, by the supervisor's clock."""
    return state.newest.time_s if state.newest else state.now_s


def _wrong_now(state: ConsoleState) -> Iterator[Alarm]:
    if state.stale:
        if not state.waits_for_supervisor:
            return
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
    if state.newest is not None and state.newest.shutting_down:
        return Alarm(
            _NO_DATA,
            False,
            f"the supervisor shut down; it was last heard {state.silent_s:.0f} s ago",
            state.received_s,
            "the console attaches to the next one by itself",
            "start one with fitctl run",
            latches=False,
        )
    return Alarm(
        _NO_DATA,
        True,
        f"NO DATA for {state.silent_s:.0f} s" + ("; what you see is old" if state.newest else ""),
        state.received_s,
        "the console reconnects by itself",
        "check the supervisor; STOP may not reach it: be ready to cut power",
        latches=False,
    )
