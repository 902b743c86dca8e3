"""A link to no supervisor, which a test feeds."""

from __future__ import annotations

import queue
from collections.abc import Callable

from fitctl.messages.commands import AnyCommand, RecentEvents, Reply, Status
from fitctl.messages.telemetry import Telemetry


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
