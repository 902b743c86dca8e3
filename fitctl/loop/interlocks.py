"""Interlocks: the rig file's table, judged by what was measured. No clock, no I/O: numbers in, trips out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from fitctl.config import QUANTITIES, Action, Interlock
from fitctl.config.interlocks import Quantity
from fitctl.messages.telemetry import TrippedInterlock, Watched

Reading = tuple[float, float, str]
"""A value, when it was measured, in s, and what there is to say about it, if it is an error's."""

_STRENGTH: dict[Action, int] = {"warn": 0, "freeze": 1, "flatten": 2, "safe": 3}
_ROUNDING_S = 1e-9


class Change(NamedTuple):
    """A row tripped, or it is over."""

    trip: TrippedInterlock
    over: bool


@dataclass(slots=True)
class _Rule:
    """One row, and how it stands."""

    name: str
    row: Interlock
    place: str
    quantity: str
    low: float
    high: float
    stale_s: float
    for_s: float
    active_since_s: float = 0.0
    turned_s: float | None = (
        None  # out of range since then; once tripped, in range again since then
    )
    trip: TrippedInterlock | None = None

    def in_range(self, reading: Reading | None, now_s: float) -> bool:
        """Whether there is nothing against it; what was measured before it is judged says nothing."""
        if reading is None or reading[1] < self.active_since_s:
            return now_s - self.active_since_s <= self.stale_s
        return self.low <= reading[0] <= self.high and now_s - reading[1] <= self.stale_s

    def begin(self, now_s: float) -> None:
        """Judge it from now on, as if for the first time."""
        self.active_since_s, self.turned_s, self.trip = now_s, None, None

    def lasted(self, now_s: float) -> bool:
        """Whether it is, for `for_s` now, not what it was before."""
        if self.turned_s is None:
            self.turned_s = now_s
        return now_s - self.turned_s >= self.for_s - _ROUNDING_S

    def reason(self, reading: Reading | None, now_s: float) -> str:
        """What is out of range, where, and the next step."""
        value, time_s, note = reading or (math.nan, -math.inf, "")
        if note:
            return note  # an error of a device says all of this itself
        quantity = QUANTITIES[self.quantity]
        age_s = now_s - max(time_s, self.active_since_s)
        if age_s > self.stale_s:
            what = f"no {self.quantity} for {age_s:.3g} s"
            todo = _remedy_of_missing(quantity)
        else:
            side = f"above {self.high:g}" if value > self.high else f"below {self.low:g}"
            out = "is not a number" if math.isnan(value) else f"{value:.4g} is {side}"
            what = f"{self.quantity} {out}" + (f" for {self.for_s:g} s" if self.for_s else "")
            todo = quantity.remedy
        return f"interlock {self.name}: {self.place}: {what}; {todo}"


def _remedy_of_missing(quantity: Quantity) -> str:
    """What to do where no reading comes."""
    if quantity.part in {"star", "beam"}:  # one that is not there has no reading either
        return quantity.remedy
    stalled = "see whether the computer stood still"
    if quantity.part == "computer":
        return stalled
    return f"check power and link of the {quantity.part}; {stalled}"


class Interlocks:
    """The table of one loop.

    Parameters
    ----------
    rows : mapping of str to Interlock
        The rig file's.
    places : mapping of str to str
        Where each part of the rig is, for people; a part that is not there is named alone.

    Attributes
    ----------
    tripped : tuple of TrippedInterlock
        In the order of the table; replaced as a whole, so that other threads may read it.
    action : str or None
        The strongest action of what is tripped.
    """

    def __init__(self, rows: Mapping[str, Interlock], places: Mapping[str, str]) -> None:
        self.tripped: tuple[TrippedInterlock, ...] = ()
        self.action: Action | None = None
        self._rules = {
            name: _Rule(
                name,
                row,
                places.get(QUANTITIES[row.quantity].part, QUANTITIES[row.quantity].part),
                row.quantity,
                -math.inf if row.low is None else row.low,
                math.inf if row.high is None else row.high,
                math.inf if row.stale_s is None else row.stale_s,
                row.for_s,
            )
            for name, row in rows.items()
        }
        self._mode = ""
        self._active: list[_Rule] = []

    @property
    def holds(self) -> bool:
        """Whether what is tripped keeps the stages from following star or beam.

        A row that resets itself does so in its own modes only: stages that stood still in a search would never
        find the star again on whose light it waits.
        """
        return self.action in {"freeze", "flatten"} and any(
            trip.action in {"freeze", "flatten"}
            and (trip.reset == "hand" or self._mode in self._rules[trip.name].row.modes)
            for trip in self.tripped
        )

    def evaluate(self, mode: str, now_s: float, readings: Mapping[str, Reading]) -> list[Change]:
        """What trips and what is over, now, by the newest reading of each quantity.

        A row is active in its own modes. One that has tripped and resets itself is watched in all modes,
        and only what is measured counts for it.
        """
        if mode != self._mode:
            self._enter(mode, now_s)
        changes = []
        for rule in self._active:
            reading = readings.get(rule.quantity)
            if (  # in line, because it is so for every row at nearly every tick
                reading is not None
                and rule.turned_s is None
                and rule.trip is None
                and rule.low <= reading[0] <= rule.high
                and rule.active_since_s <= reading[1] >= now_s - rule.stale_s
            ):
                continue
            if rule.trip is not None:
                continue
            if rule.in_range(reading, now_s):
                rule.turned_s = None
            elif rule.lasted(now_s):
                changes.append(Change(_trip(rule, reading, now_s), over=False))
        for trip in self.tripped:
            rule = self._rules[trip.name]
            reading = readings.get(rule.quantity)
            if trip.reset == "hand":
                continue
            if not rule.in_range(reading, now_s):
                rule.turned_s = None
            elif rule.lasted(now_s):
                rule.begin(now_s)
                changes.append(Change(trip, over=True))
        if changes:
            self._sum_up()
        return changes

    def reset(self, name: str, now_s: float, readings: Mapping[str, Reading]) -> str:
        """Reset a tripped interlock by hand; return the reason if it stays tripped."""
        rule = self._rules.get(name)
        if rule is None:
            return f"no interlock is named {name}; this loop has {', '.join(self._rules)}"
        if rule.trip is None:
            return f"interlock {name} is not tripped"
        reading = readings.get(rule.quantity)
        if rule in self._active and not rule.in_range(reading, now_s):
            return f"it would trip again: {rule.reason(reading, now_s)}"
        rule.begin(now_s)
        self._sum_up()
        return ""

    def reset_all(self, now_s: float) -> None:
        """Judge every row anew."""
        for rule in self._rules.values():
            rule.begin(now_s)
        self._sum_up()

    def watched(self, now_s: float, readings: Mapping[str, Reading]) -> list[Watched]:
        """Every row beside its quantity as last measured; may be asked from any thread."""
        active = set(map(id, self._active))
        rows = []
        for rule in self._rules.values():
            value, time_s, _ = readings.get(rule.quantity, (math.nan, math.nan, ""))
            rows.append(
                Watched(
                    name=rule.name,
                    quantity=rule.quantity,
                    value=value,
                    age_s=now_s - time_s,
                    low=rule.row.low,
                    high=rule.row.high,
                    stale_s=rule.row.stale_s,
                    action=rule.row.action,
                    judged=id(rule) in active,
                )
            )
        return rows

    def _enter(self, mode: str, now_s: float) -> None:
        for rule in self._rules.values():
            newly = mode in rule.row.modes and self._mode not in rule.row.modes
            if newly and rule.trip is None:
                rule.begin(now_s)
        self._mode = mode
        self._active = [rule for rule in self._rules.values() if mode in rule.row.modes]

    def _sum_up(self) -> None:
        trips = [rule.trip for rule in self._rules.values() if rule.trip is not None]
        self.tripped = tuple(trips)
        actions = sorted((trip.action for trip in trips), key=_STRENGTH.__getitem__)
        self.action = actions[-1] if actions else None


def _trip(rule: _Rule, reading: Reading | None, now_s: float) -> TrippedInterlock:
    rule.turned_s = None
    rule.trip = TrippedInterlock(
        name=rule.name,
        since_s=now_s,
        action=rule.row.action,
        reset=rule.row.reset,
        reason=rule.reason(reading, now_s),
    )
    return rule.trip
