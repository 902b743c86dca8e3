"""What the console needs of a running supervisor, and nothing more."""

from __future__ import annotations

from typing import Protocol

from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.telemetry import Telemetry


class Link(Protocol):
    """A connection to one supervisor that restores itself.

    `receive` is called on one reader thread. `send` is called on a fresh thread for every command, so
    several calls may overlap: a stop must never wait for the answer to an earlier command.
    """

    def receive(self, timeout_s: float) -> Telemetry | None:
        """The next telemetry message; None when nothing came in time."""
        ...

    def send(self, command: AnyCommand) -> Reply:
        """Give a command and wait, up to about a second, for the answer.

        Raises
        ------
        ConnectionError
            When nobody answers.
        """
        ...

    def close(self) -> None:
        """Let go of the connection; safe to call twice."""
        ...
