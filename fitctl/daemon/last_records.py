"""The end of a run's log: the recorder writes the remaining records, and missing ones are reported."""

from __future__ import annotations

import time
from collections.abc import Callable

from fitctl.daemon.children import END_S, Child
from fitctl.logging.queue import RecordQueue

HELLO_S = 60.0  # for a recorder that is still being started, on a machine with far too much to do
_SILENT_S = 2.0  # so long nobody wonders
_LAST_WORD_S = 0.2  # for a confirmation that is on its way still


def finish_log(queue: RecordQueue, recorder: Child, tell: Callable[[str], None]) -> None:
    """Let the recorder write everything and end, and close the queue.

    A recorder that is told to end while it is still being started ends at once, without a log; so one that
    was never heard is told only when it has been sent everything. One that was heard and takes nothing hangs.

    Parameters
    ----------
    queue : RecordQueue
    recorder : Child
    tell : callable
        Takes a line for people where this takes long, and where something may be missing from the log.
    """

    def unsent() -> bool:
        return recorder.running and queue.unsent > 0

    end_s = time.monotonic() + END_S
    queue.pump_while(unsent, _SILENT_S)
    if unsent() and not queue.heard:
        tell(f"waiting for the recorder to take the records of this run, up to {HELLO_S:g} s")
        queue.pump_while(unsent, HELLO_S)
        end_s = time.monotonic() + END_S
    recorder.ask_to_end()
    queue.pump_while(lambda: recorder.running, end_s - time.monotonic())
    hung = recorder.running
    recorder.end(timeout_s=0.0)
    queue.pump_while(lambda: queue.waiting, _LAST_WORD_S)
    missing = queue.waiting
    queue.close(timeout_s=0.0)
    if hung or missing:
        why = f"did not end within {END_S:g} s and was killed; it " if hung else ""
        tell(
            f"the recorder {why}did not confirm the last {missing} of {queue.offered} records; what it has "
            "not written is not in the log; an unfinished file is mended by: fitctl log recover"
        )
