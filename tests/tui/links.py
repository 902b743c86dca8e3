"""Links to no supervisor: one that a test feeds, and one that runs in real time."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator

import msgspec

from fitctl.supervisor.messages import (
    AnyCommand,
    RecentEvents,
    Reply,
    Status,
    Telemetry,
)
from tests.tui.fake import MESSAGE_S, START_S, FakeSupervisor


class FakeLink:
    """Delivers what a test puts in, keeps what was sent, and answers as the test says.

    What the console sends of its own accord, to keep the instrument and to hear of earlier events, is
    only counted.
    """

    def __init__(self, answer: Callable[[AnyCommand], Reply] | None = None) -> None:
        self.incoming: queue.Queue[Telemetry] = queue.Queue()
        self.sent: list[AnyCommand] = []
        self.kept = 0
        self.asked_for_events = 0
        self.closed = False
        self._answer = answer or (lambda _command: Reply(accepted=True))

    def deliver(self, messages: list[Telemetry]) -> None:
        for message in messages:
            self.incoming.put(message)

    def receive(self, timeout_s: float) -> Telemetry | None:
        try:
            return self.incoming.get(timeout=min(timeout_s, 0.02))
        except queue.Empty:
            return None

    def send(self, command: AnyCommand) -> Reply:
        if isinstance(command, Status):
            self.kept += 1
        elif isinstance(command, RecentEvents):
            self.asked_for_events += 1
        else:
            self.sent.append(command)
        return self._answer(command)

    def close(self) -> None:
        self.closed = True


class LiveLink(FakeLink):
    """The fake supervisor in real time, through the codec as over a socket: for looking and measuring."""

    def __init__(self, supervisor: FakeSupervisor) -> None:
        super().__init__()
        self._messages = self._paced(supervisor)
        self._lock = threading.Lock()

    def receive(self, timeout_s: float) -> Telemetry | None:
        with self._lock:
            return next(self._messages)

    def _paced(self, supervisor: FakeSupervisor) -> Iterator[Telemetry]:
        decoder = msgspec.msgpack.Decoder(Telemetry)
        ready = [msgspec.msgpack.encode(message) for message in supervisor.messages(600)]
        shift_s = time.monotonic() - START_S
        due_s = time.monotonic()
        while True:
            for encoded in ready:
                due_s += MESSAGE_S
                time.sleep(max(0.0, due_s - time.monotonic()))
                yield _shifted(decoder.decode(encoded), shift_s)
            shift_s += len(ready) * MESSAGE_S


def _shifted(message: Telemetry, shift_s: float) -> Telemetry:
    replace = msgspec.structs.replace
    return replace(
        message,
        time_s=message.time_s + shift_s,
        wall_minus_monotonic_s=message.wall_minus_monotonic_s - shift_s,
        loops=[replace(loop, since_s=loop.since_s + shift_s) for loop in message.loops],
        ticks=[replace(tick, time_s=tick.time_s + shift_s) for tick in message.ticks],
        events=[replace(event, time_s=event.time_s + shift_s) for event in message.events],
        mode_changes=[
            replace(change, time_s=change.time_s + shift_s) for change in message.mode_changes
        ],
    )
