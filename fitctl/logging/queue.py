"""From the supervisor to the recorder without ever waiting.

A record stays in the queue until the recorder has confirmed that it is in the file, so a recorder that
dies and is started again is sent what its predecessor had not yet written. What does not fit meanwhile
is refused and counted.

The wire is ZeroMQ: the queue binds a ROUTER, the recorder connects a DEALER.

=================  ========================================================================
queue to recorder  one message a record: an :class:`Envelope` as msgpack
recorder to queue  one msgpack integer: -1 "I am new", else "all up to this sequence is written"
=================  ========================================================================

The queue sends only to the recorder that sent -1 last. That one is first sent the run's
:class:`RunInfo` again, if its predecessor had it already, under the sequence last confirmed: so it knows
the run and sees every record that is missing after that as a gap.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable

import msgspec
import zmq

from fitctl.logging.errors import LogError
from fitctl.logging.records import RECORD_VERSION, AnyRecord, Envelope, RunInfo

_NEW = -1
_STEPS_PER_OFFER = 8  # a backlog is worked off in small steps, so that no single tick pays for it
_OFFERS_PER_LISTEN = 16  # looking for an answer costs as much as sending
_POLL_MS = 5
_encode = msgspec.msgpack.Encoder().encode
_decode_answer = msgspec.msgpack.Decoder(int).decode


class RecordQueue:
    """The supervisor's side; every method is for one and the same thread.

    Parameters
    ----------
    endpoint : str
        Where to bind, such as ``ipc://<folder>/records``.
    size : int
        Records kept until they are confirmed.

    Raises
    ------
    LogError
        If the endpoint cannot be bound.
    """

    def __init__(self, endpoint: str, size: int) -> None:
        self.lost = 0
        self._size = size
        self._next_sequence = 0
        self._confirmed = _NEW
        self._kept: deque[tuple[int, bytes]] = deque()
        self._sent = 0  # how many of the kept ones, oldest first, this recorder has been sent
        self._recorder: bytes | None = None
        self._run_info: RunInfo | None = None
        self._endpoint = endpoint
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.SNDHWM, size)
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # say when the recorder is gone or full
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            msg = f"{endpoint}: cannot be bound for the recorder: {error}; does its folder exist?"
            raise LogError(msg) from error

    @property
    def offered(self) -> int:
        """Records so far, taken or not."""
        return self._next_sequence

    @property
    def waiting(self) -> int:
        """Records that are not yet confirmed."""
        return len(self._kept)

    @property
    def heard(self) -> bool:
        """A recorder has connected."""
        return self._recorder is not None

    @property
    def unsent(self) -> int:
        """Those of the waiting that this recorder was not yet sent."""
        return len(self._kept) - self._sent

    def offer(self, record: AnyRecord) -> None:
        """Take a record for the log, at once; if the queue is full, count it in ``lost``."""
        sequence = self._next_sequence
        self._next_sequence += 1
        filling = 2 * len(self._kept) >= self._size
        if self._recorder is None or filling or sequence % _OFFERS_PER_LISTEN == 0:
            self._listen()
        self._forget(_STEPS_PER_OFFER)
        if isinstance(record, RunInfo):
            self._run_info = record
        if len(self._kept) >= self._size:
            self.lost += 1
        else:
            self._kept.append((sequence, _encode(Envelope(RECORD_VERSION, sequence, record))))
        self._send(_STEPS_PER_OFFER)

    def pump(self) -> None:
        """Hear the recorder and go on sending, without a new record: for quiet times."""
        self._listen()
        self._forget(_STEPS_PER_OFFER)
        self._send(_STEPS_PER_OFFER)

    def bind_again(self) -> None:
        """Make the socket's file anew, which somebody has removed; a recorder that is connected stays so.

        Raises
        ------
        zmq.ZMQError
            If that cannot be done; the next call may succeed.
        """
        with contextlib.suppress(zmq.ZMQError):
            self._socket.unbind(self._endpoint)
        self._socket.bind(self._endpoint)

    def pump_while(self, going_on: Callable[[], object], timeout_s: float) -> None:
        """Hear the recorder and send whatever is there, as long as `going_on`, within the time."""
        deadline_s = time.monotonic() + timeout_s
        while going_on() and time.monotonic() < deadline_s:
            self._socket.poll(_POLL_MS)
            self._listen()
            self._forget(len(self._kept))
            self._send(len(self._kept))

    def close(self, timeout_s: float = 0.5) -> None:
        """Send what is still there within the time, and close; safe to call twice.

        Records that could not even be sent are counted in ``lost``.
        """
        if self._socket.closed:
            return
        self.pump_while(lambda: self.unsent, timeout_s)
        self.lost += self.unsent
        self._kept.clear()
        self._sent = 0
        self._context.destroy(linger=int(timeout_s * 1000))

    def _listen(self) -> None:
        while self._socket.poll(0):
            parts = self._socket.recv_multipart(zmq.NOBLOCK)
            with contextlib.suppress(msgspec.DecodeError):  # not from a recorder of ours
                self._hear(parts[0], _decode_answer(parts[-1]))

    def _hear(self, recorder: bytes, confirmed: int) -> None:
        if confirmed == _NEW:
            self._start_over(recorder)
        elif recorder == self._recorder and confirmed < self._next_sequence:
            self._confirmed = max(self._confirmed, confirmed)

    def _start_over(self, recorder: bytes) -> None:
        """Send a new recorder everything that none has confirmed, and the run's description first."""
        self._forget(len(self._kept))
        self._recorder = recorder
        self._sent = 0
        if self._run_info is not None and self._confirmed != _NEW:
            self._pass_on(_encode(Envelope(RECORD_VERSION, self._confirmed, self._run_info)))

    def _forget(self, most: int) -> None:
        """Drop confirmed records."""
        for _ in range(most):
            if not self._kept or self._kept[0][0] > self._confirmed:
                return
            self._kept.popleft()
            self._sent = max(0, self._sent - 1)

    def _send(self, most: int) -> None:
        for _ in range(most):
            if self._sent == len(self._kept) or not self._pass_on(self._kept[self._sent][1]):
                return
            self._sent += 1

    def _pass_on(self, data: bytes) -> bool:
        """Hand one message to ZeroMQ if there is a recorder and room on the way to it."""
        if self._recorder is None:
            return False
        try:
            self._socket.send_multipart([self._recorder, data], zmq.NOBLOCK)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            self._recorder = None  # it died; the next one announces itself
            return False
        return True


class RecordReceiver:
    """The recorder's side.

    Parameters
    ----------
    endpoint : str
        What the :class:`RecordQueue` binds; it may come later.

    Raises
    ------
    LogError
        If the endpoint is not a ZeroMQ address.
    """

    def __init__(self, endpoint: str) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            msg = f"{endpoint}: cannot be connected to: {error}; expected ipc://path or tcp://host:port"
            raise LogError(msg) from error
        self._answer(_NEW)

    def receive(self, timeout_s: float) -> bytes | None:
        """The next message, or None when none came in time."""
        if not self._socket.poll(int(timeout_s * 1000)):
            return None
        return self._socket.recv()

    def confirm(self, sequence: int) -> None:
        """Confirm that everything up to `sequence` is in the file."""
        self._answer(sequence)

    def close(self) -> None:
        """Disconnect, after a last confirmation has had a moment to leave; safe to call twice."""
        self._context.destroy(linger=500)

    def _answer(self, number: int) -> None:
        with contextlib.suppress(zmq.Again):  # there is no supervisor
            self._socket.send(_encode(number), zmq.NOBLOCK)
