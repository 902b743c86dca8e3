"""A recorder on virtual time that can die, behind the supervisor's real record queue.

`Wire` replaces ZeroMQ. It keeps each message until the recorder receives it, and loses all of them when the
recorder dies. A recorder that dies also loses what it has not flushed. A new one starts a second later.
"""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import msgspec

from benchmarks.swarm.threads import VirtualTime
from fitctl.logging.queue import RecordQueue

_TAKE_S, _FLUSH_S = 0.05, 0.5
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
    """

    def __init__(self) -> None:
        self.size = 0
        self.recorder = b""
        self.sent: deque[bytes] = deque()
        self.closed = False
        self._answers: deque[tuple[bytes, bytes]] = deque()

    def answer(self, number: int) -> None:
        """Send an answer from the recorder."""
        self._answers.append((self.recorder, _encode(number)))

    def poll(self, _timeout_ms: int) -> bool:
        """Whether an answer has arrived."""
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


class SwarmRecorder:
    """The recorder of one supervisor, restarted as long as the supervisor lives.

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
        self._wire: Wire = queue._socket  # type: ignore[assignment]
        self._unflushed: list[int] = []
        self._starts = 0
        self._ended = False
        self.stuck_until_s = 0.0
        self._start()

    def end(self) -> None:
        """Stop for good, because the supervisor has ended."""
        self._ended = True

    def die(self) -> None:
        """Die, and start again after a second."""
        if self._ended or not self._wire.recorder:
            return
        self._wire.recorder = b""
        self._wire.sent.clear()
        self._unflushed.clear()
        self._time.call_at(self._time.now_s() + _BACK_S, self._start)

    def _start(self) -> None:
        if self._ended:
            return
        self._starts += 1
        self._wire.recorder = str(self._starts).encode()
        self._wire.answer(-1)
        self._flush_s = self._time.now_s() + _FLUSH_S
        self._take(self._starts)

    def _take(self, start: int) -> None:
        """Receive all messages, and flush when due. Does nothing if the recorder was restarted meanwhile."""
        if self._ended or start != self._starts or not self._wire.recorder:
            return
        now_s, goes_on_s = self._time.now_s(), max(self.stuck_until_s, self._time.goes_on_s)
        if now_s < goes_on_s:
            self._time.call_at(goes_on_s, lambda: self._take(start))
            return
        sent = self._wire.sent
        while sent:
            _version, sequence, _record = _sequence_of(sent.popleft())
            self._unflushed.append(sequence)
        if now_s >= self._flush_s and self._unflushed:
            if self.disk_is_full:
                self.die()
                return
            self._flush_s = now_s + _FLUSH_S
            self.written.update(self._unflushed)
            self._wire.answer(self._unflushed[-1])
            self._unflushed.clear()
        self._time.call_at(now_s + _TAKE_S, lambda: self._take(start))

    def waits_since(self, offered: int) -> int:
        """How many of the first so many records still wait to be written."""
        return sum(1 for sequence, _ in self._queue._kept if sequence < offered)

    def unaccounted(self) -> str:
        """Report records that are neither written, waiting nor counted as lost; empty without any."""
        queue = self._queue
        waiting = {sequence for sequence, _ in queue._kept}
        missing = queue.offered - len(self.written | waiting)
        if missing == queue.lost:
            return ""
        return (
            f"{queue.offered} offered, {missing} neither written nor waiting, {queue.lost} counted"
        )
