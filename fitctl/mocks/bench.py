"""The bench's own knowledge: where the star truly was. A referee for judging runs, not a device.

ZeroMQ REP on 127.0.0.1, msgpack. Known limitation: history is as long as ``plant.history_s``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

import msgspec
import numpy as np
import zmq
import zmq.asyncio

from fitctl.model.plant import Plant

_MAX_QUESTION_BYTES = 1024
_TIMEOUT_MS = 5000


class ResidualQuestion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Asks how far the star was from a target, from one host time to another."""

    loop: str
    start_s: float
    end_s: float
    target_az_px: float
    target_el_px: float


class Residual(msgspec.Struct, frozen=True):
    """RMS distance of the pointing spot from the target, every plant step; NaN without samples."""

    az_rms_px: float
    el_rms_px: float
    samples: int
    error: str = ""


class Bench:
    """Answers questions about the truth until stopped."""

    def __init__(self, plants: Mapping[str, Plant], started_s: float, port: int) -> None:
        self._plants = plants
        self._started_s = started_s
        self._port = port
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.REP)
        self._task: asyncio.Task | None = None

    def start(self) -> int:
        """Listen; returns the port."""
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _MAX_QUESTION_BYTES)
        if self._port:
            self._socket.bind(f"tcp://127.0.0.1:{self._port}")
        else:
            self._port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._task = asyncio.create_task(self._serve())
        return self._port

    async def stop(self) -> None:
        """Close."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._socket.close()
        self._context.term()

    async def _serve(self) -> None:
        while True:
            answer = self._answer(await self._socket.recv())
            await self._socket.send(msgspec.msgpack.encode(answer))

    def _answer(self, message: bytes) -> Residual:
        try:
            question = msgspec.msgpack.decode(message, type=ResidualQuestion)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            return Residual(np.nan, np.nan, 0, f"not a question: {error}")
        if not np.all(np.isfinite([question.start_s, question.end_s])):
            return Residual(np.nan, np.nan, 0, "start_s and end_s must be times")
        plant = self._plants.get(question.loop)
        if plant is None:
            return Residual(np.nan, np.nan, 0, f"no loop is named {question.loop}")
        track_px = plant.history_px(
            question.start_s - self._started_s, question.end_s - self._started_s
        )[:, 0, 0, :]
        if len(track_px) == 0:
            return Residual(np.nan, np.nan, 0, "no history for that time")
        error_px = track_px - [question.target_az_px, question.target_el_px]
        az, el = np.sqrt(np.mean(error_px**2, axis=0))
        return Residual(float(az), float(el), len(track_px))


def ask_bench(port: int, question: ResidualQuestion) -> Residual:
    """Ask a running bench.

    Raises
    ------
    ConnectionError
        If none answers within five seconds.
    """
    context = zmq.Context()
    try:
        with context.socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(f"tcp://127.0.0.1:{port}")
            socket.send(msgspec.msgpack.encode(question))
            if not socket.poll(_TIMEOUT_MS):
                msg = f"the mock testbed's bench does not answer at 127.0.0.1:{port}"
                raise ConnectionError(msg)
            return msgspec.msgpack.decode(socket.recv(), type=Residual)
    finally:
        context.term()
