"""Commands that take time: each that is accepted ends, once, in every loop that it was given to."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from typing import Literal

import msgspec

from fitctl.clock import Clock
from fitctl.logging.records import ModeChange
from fitctl.loop.loop import Loop
from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import Acquire, AnyCommand
from fitctl.messages.modes import COMMANDS, HOLDING, POINTING, Mode, Trigger
from fitctl.messages.telemetry import CommandOutcome, LoopFailure, LoopState

_ENDED_KEPT = 4  # of each loop
_ACQUIRE = ROWS[Acquire].word


class Outcomes:
    """How commands that take time end; and what failed last in each loop.

    Whoever carries a command out reports its end with :meth:`end`. The end of a search is read off the changes
    of mode. Filled by the supervisor's main thread; :meth:`add_to` may be called from any.

    Parameters
    ----------
    loops : iterable of str
    clock : Clock
    """

    def __init__(self, loops: Iterable[str], clock: Clock) -> None:
        self._clock = clock
        self._numbers = itertools.count(1)
        names = list(loops)
        # Replaced as a whole, so that other threads may read them.
        self._outcomes: dict[str, tuple[CommandOutcome, ...]] = dict.fromkeys(names, ())
        self._failures: dict[str, LoopFailure | None] = dict.fromkeys(names)
        self._changes: dict[str, ModeChange | None] = dict.fromkeys(names)

    def begin(self, command: AnyCommand, names: Iterable[str]) -> int:
        """Begin an accepted command in these loops; its number, 0 if its reply is its outcome.

        What failed in them before is over. A command of the same kind that is under way has been replaced.
        """
        row, now_s = ROWS[type(command)], self._clock.now_s()
        number = next(self._numbers) if row.wait_s else 0
        for name in names:
            self._failures[name] = None
            if not number:
                continue
            earlier = self._under_way(name, row.word)
            if earlier is not None:
                self._end(name, earlier, "ended", f"another {row.word} replaced it")
            new = CommandOutcome(number=number, command=row.word, began_s=now_s)
            self._outcomes[name] = (*self._outcomes[name], new)
        return number

    def end(self, number: int, names: Iterable[str], text: str, *, failed: bool) -> None:
        """End a command in these loops, unless it was replaced meanwhile."""
        for name in names:
            for outcome in self._outcomes[name]:
                if outcome.number == number and outcome.state == "under way":
                    self._end(name, outcome, "failed" if failed else "done", text)

    def observe(self, loops: Mapping[str, Loop]) -> None:
        """End searches whose loop has changed its mode since the last call."""
        for name, loop in loops.items():
            change = loop.last_change
            if change is not None and change is not self._changes[name]:
                self._changes[name] = change
                self._observe(name, change)

    def add_to(self, state: LoopState) -> LoopState:
        """A loop's state with its outcomes and its last failure."""
        return msgspec.structs.replace(
            state,
            outcomes=list(self._outcomes[state.name]),
            last_failure=self._failures[state.name],
        )

    def _observe(self, name: str, change: ModeChange) -> None:
        target, trigger = Mode[change.target], Trigger[change.trigger]
        acquiring = self._under_way(name, _ACQUIRE)
        if acquiring is not None and target in HOLDING:
            self._end(name, acquiring, "done", f"{target.name}: {change.reason}")
        elif acquiring is not None and target not in POINTING and trigger in COMMANDS:
            self._end(name, acquiring, "ended", f"{trigger.name.lower()} ended the search")
        elif acquiring is not None and target not in POINTING:
            self._end(name, acquiring, "failed", change.reason)
        elif trigger is Trigger.SEARCH_EXHAUSTED:
            self._fail(name, "search", change.reason)

    def _under_way(self, name: str, word: str) -> CommandOutcome | None:
        under_way = (each for each in self._outcomes[name] if each.state == "under way")
        return next((each for each in under_way if each.command == word), None)

    def _end(
        self,
        name: str,
        outcome: CommandOutcome,
        state: Literal["done", "failed", "ended"],
        text: str,
    ) -> None:
        ended = msgspec.structs.replace(
            outcome, state=state, text=text, ended_s=self._clock.now_s()
        )
        others = [each for each in self._outcomes[name] if each is not outcome]
        past = [each for each in others if each.state != "under way"][-_ENDED_KEPT + 1 :]
        under_way = [each for each in others if each.state == "under way"]
        self._outcomes[name] = (*past, ended, *under_way)
        if state == "failed":
            self._fail(name, outcome.command, text)

    def _fail(self, name: str, what: str, text: str) -> None:
        self._failures[name] = LoopFailure(what=what, time_s=self._clock.now_s(), text=text)
