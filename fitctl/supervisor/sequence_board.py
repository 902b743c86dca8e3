"""The sequence that reports to this supervisor: shown to every console, and what people want of it."""

from __future__ import annotations

from typing import Literal

import msgspec

from fitctl.logging.records import MOST, Severity
from fitctl.messages.commands import Reply, SequenceStatus
from fitctl.stages.journal import Journal

SILENCE_S = 3.0
_SOURCE = "sequence"  # of its events
_UNDER_WAY = ("running", "paused")
_WANTED: dict[str, Literal["run", "pause", "end"]] = {
    "pause": "pause",
    "resume": "run",
    "end": "end",
}


class SequenceBoard:
    """The newest sequence's status; at most one sequence is under way.

    Reports and orders come from the loop's thread; :meth:`status` may be asked from any.

    Parameters
    ----------
    journal : Journal
    """

    def __init__(self, journal: Journal) -> None:
        self._clock = journal.clock
        self._journal = journal
        self._heard_s = journal.clock.now_s()
        self._status: SequenceStatus | None = None

    def status(self) -> SequenceStatus | None:
        """Of the sequence that is under way or has just ended; None after `SILENCE_S` without a word."""
        silent = self._clock.now_s() - self._heard_s > SILENCE_S
        return None if silent else self._status

    @property
    def under_way(self) -> bool:
        """A sequence is running or paused."""
        status = self.status()
        return status is not None and status.state in _UNDER_WAY

    def report(self, status: SequenceStatus) -> Reply:
        """Take a sequence's word, unless another is under way, or it has numbers that cannot be."""
        if not _is_possible(status, self._clock.now_s()):
            text = (
                f"sequence {status.name}: expected numbers of steps, and times between 0 and now; "
                "report what a sequence has done"
            )
            return Reply(accepted=False, text=text)
        known = self.status()
        if known is not None and known.run != status.run and known.state in _UNDER_WAY:
            text = (
                f"sequence {known.name} is under way (step {known.step_number} of {known.steps}); wait for "
                "its end, or: fitctl sequence end"
            )
            return Reply(accepted=False, text=text)
        before = self._status
        if before is not None and before.run != status.run:
            before = None  # another one's orders are not handed on
        self._heard_s = self._clock.now_s()
        self._status = msgspec.structs.replace(
            status, wanted="run" if before is None else before.wanted
        )
        self._report_change(before, status)
        return Reply(accepted=True)

    def control(self, action: Literal["pause", "resume", "end"]) -> Reply:
        """Leave an order, which the sequence reads in the telemetry."""
        known = self.status()
        if known is None or known.state not in _UNDER_WAY:
            return Reply(accepted=False, text=f"{action}: no sequence is under way")
        if known.wanted == "end":
            return Reply(accepted=False, text=f"{action}: sequence {known.name} is being stopped")
        self._status = msgspec.structs.replace(known, wanted=_WANTED[action])
        self._journal.event("info", _SOURCE, f"{known.name}: {action}, by the operator")
        return Reply(accepted=True)

    def _report_change(self, before: SequenceStatus | None, now: SequenceStatus) -> None:
        if now.last_attempt is not None and (
            before is None or before.last_attempt != now.last_attempt
        ):
            self._journal.record(now.last_attempt)
        if before is None:
            self._journal.event(
                "info", _SOURCE, f"{now.name} begins, {now.steps} step{'s' * (now.steps != 1)}"
            )
        elif before.state != now.state:
            severity: Severity = "warning" if now.state in {"failed", "stopped"} else "info"
            detail = f": {now.message}" if now.message else ""
            self._journal.event(severity, _SOURCE, f"{now.name} {now.state}{detail}")


def _is_possible(status: SequenceStatus, now_s: float) -> bool:
    """Whether a program's report can be logged and shown."""
    counts, times_s = [status.steps, status.step_number, status.attempt], []
    if (last := status.last_attempt) is not None:
        counts += [last.step_number, last.attempt]
        times_s = [last.time_s, last.began_s, last.ended_s]
    # NaN is neither.
    return all(0 <= count < MOST for count in counts) and all(
        0 <= at_s <= now_s for at_s in times_s
    )
