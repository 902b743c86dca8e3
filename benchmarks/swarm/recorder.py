"""A recorder on virtual time that can die, behind the supervisor's real record queue.

`Wire` replaces ZeroMQ. It keeps each message until the recorder receives it, and loses all of them when the
recorder dies. A recorder that dies also loses what it has not flushed. A new one starts a second later, unless
the log is being finished.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import patch

import msgspec

from benchmarks.swarm.threads import VirtualTime
from fitctl.daemon.last_records import finish_log
from fitctl.logging.queue import RecordQueue

_TAKE_S, _FLUSH_S = 0.05, 0.5
_QUIET_S, _DRAIN_S = 0.2, 2.0  # as in fitctl.logging.recorder
_BACK_S = 1.0  # fitctl.daemon.children checks once a second
_encode = msgspec.msgpack.encode
_sequence_of = msgspec.msgpack.Decoder(tuple[int, int, msgspec.Raw]).decode
_UNREACHABLE, _AGAIN = 113, 11


class WireError(Exception):
    """Stands for ``zmq.ZMQError``."""

    def __init__(self, errno: int) -> None:
        super().__init__(errno)
        self.errno = errno


class FullError(WireError):
    """Stands for ``zmq.Again``."""


class Wire:
    """Stands for the queue's ROUTER socket and the recorder's end of it.

    Attributes
    ----------
    size : int
        Maximum number of messages on the wire.
    recorder : bytes
        Identity of the connected recorder; empty without one.
    sleep : callable
        Waits on virtual time.
    """

    def __init__(self) -> None:
        self.size = 0
        self.sleep: Callable[[float], None] = lambda _duration_s: None
        self.recorder = b""
        self.sent: deque[bytes] = deque()
        self.closed = False
        self._answers: deque[tuple[bytes, bytes]] = deque()

    def answer(self, number: int) -> None:
        """Send an answer from the recorder."""
        self._answers.append((self.recorder, _encode(number)))

    def poll(self, timeout_ms: int) -> bool:
        """Whether an answer has arrived, if need be after the timeout."""
        if timeout_ms and not self._answers:
            self.sleep(timeout_ms / 1e3)
        return bool(self._answers)

    def recv_multipart(self, _flags: int) -> tuple[bytes, bytes]:
        """The oldest answer."""
        return self._answers.popleft()

    def send_multipart(self, parts: list[bytes], _flags: int) -> None:
        """Send, if a recorder is connected and the wire has room."""
        if parts[0] != self.recorder:
            raise WireError(_UNREACHABLE)
        if len(self.sent) >= self.size:
            raise FullError(_AGAIN)
        self.sent.append(parts[1])

    def setsockopt(self, option: int, value: int) -> None:
        """Set how many messages the wire takes."""
        if option == ZMQ.SNDHWM:
            self.size = value

    def bind(self, _endpoint: str) -> None:
        """Do nothing: a wire has only these two ends."""


ZMQ = SimpleNamespace(
    Context=lambda: SimpleNamespace(socket=lambda _kind: Wire(), destroy=lambda **_: None),
    ZMQError=WireError,
    Again=FullError,
    EHOSTUNREACH=_UNREACHABLE,
    ROUTER=0,
    SNDHWM=1,
    ROUTER_MANDATORY=2,
    NOBLOCK=0,
)
"""Stands for the parts of the module ``zmq`` that the queue uses."""


@contextmanager
def installed(time: VirtualTime) -> Iterator[None]:
    """Record queues have a `Wire`, and wait on virtual time, meanwhile."""
    clock = SimpleNamespace(monotonic=time.now_s)
    with (
        patch("fitctl.logging.queue.zmq", ZMQ),
        patch("fitctl.logging.queue.time", clock),
        patch("fitctl.daemon.last_records.time", clock),
    ):
        yield


class SwarmRecorder:
    """The recorder of one supervisor, restarted as long as the supervisor lives.

    To `finish_log` it is a :class:`fitctl.daemon.children.Child`.

    Parameters
    ----------
    time : VirtualTime
    queue : RecordQueue
        A queue whose socket is a `Wire`.

    Attributes
    ----------
    written : set of int
        Sequence numbers of the records in its files.
    disk_is_full : bool
        While true, a flush kills the recorder.
    stuck_until_s : float
        It neither receives nor writes until then, as on a disk that hangs.
    """

    def __init__(self, time: VirtualTime, queue: RecordQueue) -> None:
        self.written: set[int] = set()
        self.disk_is_full = False
        self._time = time
        self._queue = queue
        self._wire: Wire = queue._socket  # pyrefly: ignore[bad-assignment]
        self._unflushed: list[int] = []
        self._starts = 0
        self._stays_dead = False
        self._ends_s = math.inf  # asked to end, it takes nothing after this time
        self.stuck_until_s = 0.0
        self._wire.sleep = time.sleep
        self._start()

    @property
    def running(self) -> bool:
        """It runs, or hangs."""
        return bool(self._wire.recorder)

    def ask_to_end(self) -> None:
        """Let it receive what is there, write everything and end."""
        self._ends_s = self._time.now_s() + _DRAIN_S

    def end(self, timeout_s: float = 0.0) -> None:
        """Kill it for good; what it has not written is lost."""
        self._stays_dead = True
        self.die()

    def finish(self) -> str:
        """The supervisor's process ends its log, and reports what may be missing.

        Returns
        -------
        str
            What is missing and was not reported; empty if all is well.
        """
        self._stays_dead = True
        reported: list[str] = []
        finish_log(self._queue, self, reported.append)  # pyrefly: ignore[bad-argument-type]
        missing = self._queue.offered - len(self.written) - self._queue.lost
        found = [re.search(r"confirm the last (\d+) of", line) for line in reported]
        unconfirmed = sum(int(match[1]) for match in found if match)
        if 0 <= missing <= unconfirmed:
            return ""
        return f"at the end {missing} are not written; reported: {'; '.join(reported) or 'nothing'}"

    def die(self) -> None:
        """Die, and start again after a second."""
        if not self._wire.recorder:
            return
        self._wire.recorder = b""
        self._wire.sent.clear()
        self._unflushed.clear()
        if not self._stays_dead:
            self._time.call_at(self._time.now_s() + _BACK_S, self._start)

    def _start(self) -> None:
        if self._stays_dead:
            return
        self._starts += 1
        self._wire.recorder = str(self._starts).encode()
        self._wire.answer(-1)
        self._quiet_from_s = self._time.now_s()
        self._flush_s = self._time.now_s() + _FLUSH_S
        self._take(self._starts)

    def _take(self, start: int) -> None:
        """Receive all messages, and flush when due. Does nothing if the recorder was restarted meanwhile."""
        if start != self._starts or not self._wire.recorder:
            return
        now_s, goes_on_s = self._time.now_s(), max(self.stuck_until_s, self._time.goes_on_s)
        if now_s < goes_on_s:
            self._time.call_at(goes_on_s, lambda: self._take(start))
            return
        sent = self._wire.sent
        if sent:
            self._quiet_from_s = now_s
        while sent:
            _version, sequence, _record = _sequence_of(sent.popleft())
            self._unflushed.append(sequence)
        is_last = self._ends_s < math.inf and (
            now_s >= self._ends_s or now_s - self._quiet_from_s >= _QUIET_S
        )
        if self._unflushed and (is_last or now_s >= self._flush_s):
            if self.disk_is_full:
                self.die()
                return
            self._flush_s = now_s + _FLUSH_S
            self.written.update(self._unflushed)
            self._wire.answer(self._unflushed[-1])
            self._unflushed.clear()
        if is_last:
            self.end()
            return
        self._time.call_at(now_s + _TAKE_S, lambda: self._take(start))

    def waits_since(self, offered: int) -> int:
        """How many of the first so many records still wait to be written."""
        return sum(1 for sequence, _ in self._queue._kept if sequence < offered)

    def unaccounted(self, made: int) -> str:
        """Report records that are neither written, waiting nor counted as lost; empty without any.

        `made` is how many the supervisor has made.
        """
        queue = self._queue
        if queue.offered != made:
            return f"{made} were made, {queue.offered} counted"
        waiting = {sequence for sequence, _ in queue._kept}
        missing = queue.offered - len(self.written | waiting)
        if missing == queue.lost:
            return ""
        return (
            f"{queue.offered} offered, {missing} neither written nor waiting, {queue.lost} counted"
        )
