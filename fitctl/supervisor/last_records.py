"""The end of a run's log: the recorder takes what is still there, and what may be missing is said."""

from __future__ import annotations

from fitctl.logging.queue import RecordQueue
from fitctl.supervisor.children import END_S, Child

HELLO_S = 15.0  # for a recorder that is still being started, on a machine with too much to do
_LAST_WORD_S = 0.2  # for a confirmation that is on its way still


def finish_log(queue: RecordQueue, recorder: Child) -> str:
    """Let the recorder write everything and end, and close the queue.

    A recorder that is told to end while it is still being started ends at once, without a log; so it is
    told only when it has been sent everything.

    Returns
    -------
    str
        What may be missing from the log, and the next step; empty if nothing is.
    """
    queue.pump_while(lambda: recorder.running and queue.unsent, HELLO_S)
    recorder.ask_to_end()
    queue.pump_while(lambda: recorder.running, END_S)
    hung = recorder.running
    recorder.end(timeout_s=0.0)
    queue.pump_while(lambda: queue.waiting, _LAST_WORD_S)
    missing = queue.waiting
    queue.close(timeout_s=0.0)
    if not (hung or missing):
        return ""
    why = f"did not end within {END_S:g} s and was killed; it " if hung else ""
    return (
        f"the recorder {why}did not confirm the last {missing} of {queue.offered} records; what it has not "
        "written is not in the log; an unfinished file is mended by: fitctl log recover"
    )
