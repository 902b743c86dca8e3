"""One moment of the past, and the state that the console's panels draw it from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from fitctl.logging.records import Event
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.history import KEPT_S
from fitctl.tui.state import EVENTS_KEPT, ConsoleState

LONGEST_SEARCH_S = 300.0  # whose path is drawn from its start


class Moment(NamedTuple):
    """What a console knew at a time.

    Attributes
    ----------
    message : Telemetry
        The newest message, with the ticks of the last minute or of the whole search.
    received_s : float
        When the message came.
    events : sequence of Event
        All until then, newest first.
    states : sequence of (float, list of LoopState)
        The loops about once a second of the last minute, oldest first.
    """

    message: Telemetry
    received_s: float
    events: Sequence[Event]
    states: Sequence[tuple[float, list[LoopState]]]


class Recording(Protocol):
    """Where moments come from. Times are in s, by the supervisor's clock."""

    def span_s(self) -> tuple[float, float]:
        """The oldest and the newest time that can be shown."""

    def at(self, time_s: float) -> Moment | None:
        """The moment at a time; None before the first message.

        Raises
        ------
        LogError
            If it cannot be read.
        """

    def events(self) -> Sequence[Event]:
        """All events, newest first. May be asked for on any thread."""


def course_from_s(loops: Sequence[LoopState], time_s: float) -> float:
    """From when on ticks are needed: a minute, or since a search began."""
    searching = [loop.since_s for loop in loops if loop.mode == "ACQUISITION"]
    return max(time_s - LONGEST_SEARCH_S, min([time_s - KEPT_S, *searching]))


def until(events: Sequence[Event], time_s: float) -> list[Event]:
    """Events until a time, newest first, as many as a console keeps."""
    return [event for event in events if event.time_s <= time_s][:EVENTS_KEPT]


def state_of(moment: Moment, time_s: float) -> tuple[ConsoleState, AlarmBook]:
    """State and alarms as a console had them at a time, drawn by the panels as live ones are."""
    state = ConsoleState(time_s)
    state.live = False
    state.accept(moment.message, moment.received_s)
    state.recall(list(reversed(moment.events)))
    for view in state.loops.values():
        view.readings.clear()
    for then_s, loops in moment.states:
        for loop in loops:
            if loop.name in state.loops:
                state.loops[loop.name].remember_readings(loop, then_s)
    state.now_s = time_s
    book = AlarmBook()
    book.update(state)
    return state, book
