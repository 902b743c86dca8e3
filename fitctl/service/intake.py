"""What is turned back before anybody asks who may command: what is no command, and what is too much.

The service and the gateway each have an intake; what they turn back is counted, and told now and then.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from fitctl.messages.commands import AnyCommand, Reply, Stop, decode_command

_REPORT_PERIOD_S = 5.0


class Accepted(NamedTuple):
    """A command; a stop is taken even when it is one too many."""

    command: AnyCommand
    over_rate: bool


class Intake:
    """Decodes, limits, counts; for one thread.

    Parameters
    ----------
    commands_per_s : float
        From one person; as many may come at once.
    """

    def __init__(self, commands_per_s: float) -> None:
        self._rate = commands_per_s
        self._too_many = Reply(
            accepted=False,
            text=f"more than {commands_per_s:g} commands a second; wait, then try again",
        )
        self._buckets: dict[str, tuple[float, float]] = {}
        self._dropped: Counter[tuple[str, str]] = Counter()
        self._report_s = 0.0

    def accept(self, name: str, payload: bytes, now_s: float) -> Accepted | Reply:
        """Somebody's message: the command in it, or why it is turned back."""
        command = decode_command(payload)
        within_rate = self.within_rate(name, now_s)
        if not within_rate and not isinstance(command, Stop):
            self.drop(name, "over the rate limit")
            return self._too_many
        if isinstance(command, Reply):
            self.drop(name, "no commands")
            return command
        return Accepted(command, not within_rate)

    def within_rate(self, name: str, now_s: float) -> bool:
        """Count one message; whether its sender may send so many."""
        left, since_s = self._buckets.get(name, (self._rate, now_s))
        left = min(self._rate, left + (now_s - since_s) * self._rate)
        self._buckets[name] = (max(0.0, left - 1.0), now_s)
        return left >= 1.0

    def drop(self, name: str, why: str) -> None:
        """Count one message that is not taken."""
        self._dropped[name, why] += 1

    def dropped(self, now_s: float) -> list[str]:
        """What is to be told of it now; nothing if something was told a moment ago."""
        if not self._dropped or now_s < self._report_s:
            return []
        self._report_s = now_s + _REPORT_PERIOD_S
        lines = [f"{name}: {count} messages, {why}" for (name, why), count in self._dropped.items()]
        self._dropped.clear()
        return lines
