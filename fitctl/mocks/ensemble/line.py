"""Commands out of bytes and answers after their time, for one client of the mock controller."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from fitctl.drivers.ensemble.protocol import COMMAND_BYTES_MAX, EOS, Reply
from fitctl.mocks.faults import Wire

_WAITING_MAX = 1000


class LineSplitter:
    """Bytes in, whole lines out; half a line waits for the rest.

    What is longer than any command is cut one byte beyond that length.
    """

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Lines that are now complete, without their newline."""
        *whole, rest = data.split(EOS)
        lines = []
        for piece in whole:
            self._add(piece)
            lines.append(bytes(self._pending))
            self._pending.clear()
        self._add(rest)
        return lines

    def clear(self) -> None:
        """Forget half a line."""
        self._pending.clear()

    def _add(self, piece: bytes) -> None:
        self._pending += piece[: COMMAND_BYTES_MAX + 1 - len(self._pending)]


class Client:
    """One client's commands, done one after the other, each answered after the controller's time.

    Parameters
    ----------
    wire : Wire
    answer : callable
        Does a line and gives the bytes of its answer.
    reply_s : float
        From when a command's turn comes until its answer.
    """

    def __init__(self, wire: Wire, answer: Callable[[str], bytes], reply_s: float) -> None:
        self._splitter = LineSplitter()
        self._wire = wire
        self._answer = answer
        self._reply_s = reply_s
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_MAX)
        self._timer: asyncio.TimerHandle | None = None

    def receive(self, data: bytes) -> None:
        """Take what the client sent."""
        if self._wire.dead:
            self._splitter.clear()
            self._waiting.clear()
            return
        self._waiting.extend(line for line in self._splitter.feed(data) if line.strip())
        self._next()

    def close(self) -> None:
        """Forget what is under way."""
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wire.close()

    def _next(self) -> None:
        if self._timer is None and self._waiting:
            line = self._waiting.popleft()
            if len(line) > COMMAND_BYTES_MAX:
                answer = Reply.NOT_UNDERSTOOD.value + EOS
            else:
                answer = self._answer(line.decode("ascii", "replace"))
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(self._reply_s, self._send, answer)

    def _send(self, answer: bytes) -> None:
        self._timer = None
        self._wire.send(answer)
        self._next()
