"""The supervisor's door: commands by ROUTER, telemetry by PUB, on Unix sockets that only their owner reads.

One thread, so that nothing here can hold the loop: records are left in bounded buffers and picked up
from there, replies likewise.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TypeVar

import msgspec
import zmq

from fitctl.clock import Clock
from fitctl.logging.records import (
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    ModeChange,
    PiezoReading,
    Record,
    RecorderStatus,
    Tick,
)
from fitctl.supervisor.endpoints import COMMAND_SOCKET, TELEMETRY_SOCKET
from fitctl.supervisor.loop_state import loop_state
from fitctl.supervisor.messages import (
    PROTOCOL_VERSION,
    AnyCommand,
    RecorderReport,
    Reply,
    Status,
    Telemetry,
)
from fitctl.supervisor.supervisor import Supervisor

_POLL_MS = 5
_MAX_COMMAND_BYTES = 4096
_BUFFERED_TICKS = 2000
_BUFFERED_EVENTS = 500

T = TypeVar("T")


class TelemetryBuffer:
    """Records on their way to the consoles; filled by the loop, emptied by the service."""

    def __init__(self) -> None:
        self.frame: FrameRecord | None = None
        self.recorder: RecorderStatus | None = None
        self._ticks: deque[Tick] = deque(maxlen=_BUFFERED_TICKS)
        self._events: deque[Event] = deque(maxlen=_BUFFERED_EVENTS)
        self._changes: deque[ModeChange] = deque(maxlen=_BUFFERED_EVENTS)
        self._devices: dict[str, DeviceHealth] = {}
        self._piezo: dict[str, PiezoReading] = {}
        self._timing: dict[str, LoopTiming] = {}

    def add(self, record: Record) -> None:
        """Take one record; never blocks."""
        match record:
            case Tick():
                self._ticks.append(record)
            case FrameRecord():
                self.frame = record
            case Event():
                self._events.append(record)
            case ModeChange():
                self._changes.append(record)
            case DeviceHealth():
                self._devices[record.device] = record
            case PiezoReading():
                self._piezo[record.loop] = record
            case LoopTiming():
                self._timing[record.loop] = record
            case RecorderStatus():
                self.recorder = record

    def telemetry(self, supervisor: Supervisor, state: ServiceState, now_s: float) -> Telemetry:
        """Everything since the last call."""
        return Telemetry(
            sequence=state.sequence,
            time_s=now_s,
            wall_minus_monotonic_s=state.wall_minus_monotonic_s,
            rig_name=supervisor.rig.name,
            pid=state.pid,
            loops=[loop_state(supervisor.rig, loop, now_s) for loop in supervisor.loops.values()],
            ticks=_drain(self._ticks),
            events=_drain(self._events),
            mode_changes=_drain(self._changes),
            frame=self.frame,
            devices=list(self._devices.values()),
            piezo=list(self._piezo.values()),
            timing=list(self._timing.values()),
            recorder=self.recorder,
            records_lost=state.records_lost(),
            scheduling=state.scheduling,
            running_sequence=supervisor.sequences.status(),
        )


def _drain(buffer: deque[T]) -> list[T]:
    return [buffer.popleft() for _ in range(len(buffer))]


class ServiceState(msgspec.Struct):
    """What telemetry carries besides records."""

    pid: int
    wall_minus_monotonic_s: float
    scheduling: str
    records_lost: Callable[[], int]
    sequence: int = 0


class Service(threading.Thread):
    """Answers commands and publishes telemetry until :meth:`stop`.

    Parameters
    ----------
    supervisor : Supervisor
    buffer : TelemetryBuffer
    folder : Path
        Where the sockets are made.
    state : ServiceState
    clock : Clock
    """

    def __init__(
        self,
        supervisor: Supervisor,
        buffer: TelemetryBuffer,
        folder: Path,
        state: ServiceState,
        clock: Clock,
    ) -> None:
        super().__init__(name="service", daemon=True)
        self._supervisor = supervisor
        self._buffer = buffer
        self._state = state
        self._clock = clock
        self._period_s = 1.0 / supervisor.rig.supervisor.telemetry_hz
        self._ending = threading.Event()
        self._replies: SimpleQueue[tuple[bytes, bytes, Reply]] = SimpleQueue()
        self._decode = msgspec.msgpack.Decoder(AnyCommand).decode
        self._encode = msgspec.msgpack.Encoder().encode
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        self._router.setsockopt(zmq.MAXMSGSIZE, _MAX_COMMAND_BYTES)
        self._router.setsockopt(zmq.LINGER, 200)
        self._router.bind(f"ipc://{folder / COMMAND_SOCKET}")
        self._publisher = self._context.socket(zmq.PUB)
        self._publisher.setsockopt(zmq.SNDHWM, 50)
        self._publisher.setsockopt(zmq.LINGER, 200)
        self._publisher.bind(f"ipc://{folder / TELEMETRY_SOCKET}")

    def stop(self) -> None:
        """Publish once more, send what replies there are, and end."""
        self._ending.set()
        self.join(timeout=5.0)

    def run(self) -> None:
        """Serve; this is the thread."""
        due_s = self._clock.now_s()
        try:
            while not self._ending.is_set():
                if self._router.poll(_POLL_MS):
                    self._receive()
                self._send_replies()
                now_s = self._clock.now_s()
                if now_s >= due_s:
                    self._publish(now_s)
                    due_s = max(due_s + self._period_s, now_s)
            self._send_replies()
            self._publish(self._clock.now_s())
        finally:
            self._router.close()
            self._publisher.close()
            self._context.term()

    def _publish(self, now_s: float) -> None:
        self._publisher.send(self._encode(self._telemetry(now_s)), zmq.NOBLOCK)

    def _telemetry(self, now_s: float) -> Telemetry:
        self._state.sequence += 1
        return self._buffer.telemetry(self._supervisor, self._state, now_s)

    def _receive(self) -> None:
        parts = self._router.recv_multipart()
        if len(parts) != 3:
            return  # not one of our clients; there is nobody to answer
        identity, tag, payload = parts
        try:
            command = self._decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            self._answer(identity, tag, Reply(accepted=False, text=f"not a command: {error}"))
            return
        if command.version != PROTOCOL_VERSION:
            text = f"this supervisor speaks version {PROTOCOL_VERSION}, not {command.version}"
            self._answer(identity, tag, Reply(accepted=False, text=text))
        elif isinstance(command, RecorderReport):
            self._buffer.recorder = command.status
            self._answer(identity, tag, Reply(accepted=True))
        elif isinstance(command, Status):
            self._answer(identity, tag, Reply(accepted=True, text=self._status_text()))
        else:
            self._supervisor.post(command, lambda reply: self._replies.put((identity, tag, reply)))

    def _status_text(self) -> str:
        return ", ".join(
            f"{name} {loop.mode.name}" for name, loop in self._supervisor.loops.items()
        )

    def _send_replies(self) -> None:
        while True:
            try:
                self._answer(*self._replies.get_nowait())
            except Empty:
                return

    def _answer(self, identity: bytes, tag: bytes, reply: Reply) -> None:
        self._router.send_multipart([identity, tag, self._encode(reply)], zmq.NOBLOCK)
