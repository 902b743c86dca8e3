"""The console's threads: one that reads telemetry, and one for every command that is on its way."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from fitctl.messages.client import Client
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.telemetry import Telemetry
from fitctl.text import UNDECODABLE

RECEIVE_TIMEOUT_S = 0.2
EXIT_WAIT_S = 2.5
UNDRAWN_MESSAGES = (
    20  # a terminal that takes nothing holds the screen up; more telemetry then waits in the link
)
UNREADABLE_NOTICE_S = 10.0  # at most one notice in this time
UNREADABLE_PAUSE_S = 0.01  # a link that fails at once must not keep a processor busy


class NoLink:
    """The link of a console that shows a log."""

    def receive(self, timeout_s: float) -> Telemetry | None:
        """Nothing comes."""
        time.sleep(timeout_s)
        return None

    def send(self, command: AnyCommand) -> Reply:
        """Nothing goes."""
        msg = f"{type(command).__name__}: no instrument is attached to a log"
        raise ConnectionError(msg)

    def close(self) -> None:
        """There is nothing to close."""


class Wire:
    """What comes and goes over a link. The callbacks are called on its threads.

    Parameters
    ----------
    link : Client or NoLink
        Called by the reader's thread, and by a thread for each command, so that a stop never waits for the
        reply to an earlier command. Closed at the end.
    clock : callable
        Monotonic time in s.
    on_telemetry : callable
        Gets each message, and calls :meth:`processed` when it is done with it.
    on_unreadable : callable
        Gets why something that came cannot be used.
    on_answer : callable
        Gets a command, its reply, and, if there is none, why.
    """

    def __init__(
        self,
        link: Client | NoLink,
        clock: Callable[[], float],
        on_telemetry: Callable[[Telemetry], object],
        on_unreadable: Callable[[str], object],
        on_answer: Callable[[AnyCommand, Reply | None, str], object],
    ) -> None:
        self._link = link
        self._clock = clock
        self._on_telemetry = on_telemetry
        self._on_unreadable = on_unreadable
        self._on_answer = on_answer
        self._ended = threading.Event()
        self._room = threading.Semaphore(UNDRAWN_MESSAGES)
        self._reader = threading.Thread(target=self._read, name="console-reader", daemon=True)
        self._senders: set[threading.Thread] = set()

    def start(self) -> None:
        """Begin to read."""
        self._reader.start()

    def processed(self) -> None:
        """One message of telemetry is no longer on its way."""
        self._room.release()

    def send(self, command: AnyCommand) -> None:
        """Send a command on a thread of its own, so that none waits for another."""
        thread = threading.Thread(
            target=self._send,
            args=(command,),
            name=f"console-{type(command).__name__}",
            daemon=True,
        )
        self._senders = {sender for sender in self._senders if sender.is_alive()} | {thread}
        thread.start()

    def close(self) -> None:
        """Wait until the sent commands have arrived (a stop above all), then close the link."""
        self._ended.set()
        deadline_s = time.monotonic() + EXIT_WAIT_S
        for thread in (*self._senders, self._reader):
            if thread.is_alive():
                thread.join(max(0.0, deadline_s - time.monotonic()))
        self._link.close()

    def _read(self) -> None:
        notice_due_s = -math.inf
        while not self._ended.is_set():
            if not self._room.acquire(timeout=RECEIVE_TIMEOUT_S):
                continue
            telemetry = None
            try:
                telemetry = self._link.receive(RECEIVE_TIMEOUT_S)
            except (ConnectionError, *UNDECODABLE) as error:
                if self._clock() >= notice_due_s:
                    notice_due_s = self._clock() + UNREADABLE_NOTICE_S
                    self._on_unreadable(str(error))
                self._ended.wait(UNREADABLE_PAUSE_S)
            if telemetry is None:
                self._room.release()
            elif not self._ended.is_set():
                self._on_telemetry(telemetry)

    def _send(self, command: AnyCommand) -> None:
        reply, problem = None, ""
        try:
            reply = self._link.send(command)
        except (ConnectionError, TimeoutError) as error:
            problem = str(error)
        except Exception as error:  # a defect, but STOP must never fail in silence
            problem = f"It failed: {type(error).__name__}: {error}"
        if not self._ended.is_set():
            self._on_answer(command, reply, problem)
