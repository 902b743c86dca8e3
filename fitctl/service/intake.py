"""What is rejected before anybody decides who may command: what is no command, and what exceeds a limit.

The service and the gateway each have an intake. Each counts what it rejects and reports the counts every
few seconds, so that a flood costs neither the loop its time nor the log its room.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import NamedTuple

from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import AnyCommand, Reply, Stop, decode_command
from fitctl.messages.keys import Role

_REPORT_PERIOD_S = 5.0
# Of one person: what is rejected beyond these is counted, neither answered nor logged one by one.
_ANSWERED_REFUSALS_PER_S = 20.0
_LOGGED_REFUSALS_PER_S = 1.0
_LOGGED_REFUSALS_AT_ONCE = 10.0
# Beside the rate of commands. Somebody who needs to stop needs one; reading a flood of them takes all the time.
_STOPS_PER_S = 50.0
_STANDSTILL_S = (
    0.25  # between two rounds; a round comes every few milliseconds, at the gateway every 0.1 s
)
_CAUGHT_UP_S = (
    0.5  # after a standstill, until what came meanwhile has been read; another one does not count
)
_OF_A_ROUND_S = (
    0.1  # counts all the same, so that who stands still again and again accepts something
)


class Accepted(NamedTuple):
    """A command; a stop is accepted even when it exceeds the rate, within a limit of its own."""

    command: AnyCommand
    over_rate: bool


class Limit:
    """So many a second for each name, and so many at once (a token bucket)."""

    def __init__(self, per_s: float, at_once: float) -> None:
        self._per_s = per_s
        self._at_once = at_once
        self._buckets: dict[str, tuple[float, float]] = {}

    def within(self, name: str, now_s: float) -> bool:
        """Count one more; whether it is within the limit."""
        left, since_s = self._buckets.get(name, (self._at_once, now_s))
        left = min(self._at_once, left + (now_s - since_s) * self._per_s)
        within = left >= 1.0
        self._buckets[name] = (left - within, now_s)
        return within


class Intake:
    """Decodes, limits, counts; for one thread.

    Parameters
    ----------
    commands_per_s : float
        From one person; as many may come at once.
    loops : collection of str
        The rig's loops: a stop for another one is not exempt from the rate.
    """

    def __init__(self, commands_per_s: float, loops: Collection[str]) -> None:
        self._stoppable = {"", *loops}
        self._too_many = Reply(
            accepted=False,
            text=f"more than {commands_per_s:g} commands a second; wait, then try again",
        )
        self._commands = Limit(commands_per_s, commands_per_s)
        self._stops = Limit(_STOPS_PER_S, _STOPS_PER_S)
        self._answers = Limit(_ANSWERED_REFUSALS_PER_S, _ANSWERED_REFUSALS_PER_S)
        self._records = Limit(_LOGGED_REFUSALS_PER_S, _LOGGED_REFUSALS_AT_ONCE)
        self._dropped: Counter[tuple[str, str]] = Counter()
        self._report_s = 0.0

    def accept(self, name: str, role: Role, payload: bytes, now_s: float) -> Accepted | Reply:
        """Decode somebody's message: the command in it, or why it is rejected.

        Only a stop that will be obeyed exceeds the rate: from somebody who may stop, for a loop that exists.
        Of these stops too, no more than 50 a second are accepted from one person.
        """
        command = decode_command(payload)
        row = None if isinstance(command, Reply) else ROWS[type(command)]
        by_program = row is not None and not (row.word or row.label)
        # A person's commands do not use up the rate of the recorder's, learner's and sequence's reports.
        within_rate = self._commands.within(f"{name} reports" if by_program else name, now_s)
        stops = (
            isinstance(command, Stop) and role == "commander" and command.loop in self._stoppable
        )
        if not within_rate and not (stops and self._stops.within(name, now_s)):
            self.drop(name, "over the rate limit")
            return self._too_many
        if isinstance(command, Reply):
            self.drop(name, "no commands")
            return command
        if command.loop and row is not None and row.of_rig:
            text = f"{type(command).__name__} is for the whole rig; expected no loop, got {command.loop}"
            return Reply(accepted=False, text=text)
        return Accepted(command, not within_rate)

    def answers_refusal(self, name: str, now_s: float) -> bool:
        """Whether one more refusal of a sender's message is answered; otherwise it is counted."""
        if self._answers.within(name, now_s):
            return True
        self.drop(name, "refused without an answer")
        return False

    def logs_refusal(self, name: str, now_s: float) -> bool:
        """Whether one more refusal of a sender's command gets a record; otherwise it is counted."""
        if self._records.within(name, now_s):
            return True
        self.drop(name, "refused without a record of its own")
        return False

    def drop(self, name: str, why: str) -> None:
        """Count one message that is rejected."""
        self._dropped[name, why] += 1

    def dropped(self, now_s: float) -> list[str]:
        """The counts that are due for a report; none if the last report was a moment ago."""
        if not self._dropped or now_s < self._report_s:
            return []
        self._report_s = now_s + _REPORT_PERIOD_S
        lines = [f"{name}: {count} messages, {why}" for (name, why), count in self._dropped.items()]
        self._dropped.clear()
        return lines
