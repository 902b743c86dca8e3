"""Waiting for the outcome of a command that takes time."""

from __future__ import annotations

import time
from typing import Protocol

from fitctl.messages.client import Client
from fitctl.messages.commands import Reply
from fitctl.messages.running import supervisor_runs
from fitctl.messages.telemetry import CommandOutcome, Telemetry

RECEIVE_S = 0.5
SILENCE_S = 5.0


class Link(Protocol):
    """A client of a supervisor, or of a simulated one."""

    def now_s(self) -> float:
        """The supervisor's time."""
        ...

    def receive(self, timeout_s: float) -> Telemetry | None:
        """The next telemetry message, or None when none came in time."""
        ...


def wait_for_outcomes(link: Link, reply: Reply, timeout_s: float) -> dict[str, CommandOutcome]:
    """Wait until an accepted command has ended in each loop that it was given to; its outcomes, by loop.

    After `timeout_s` they are returned as they are then, perhaps still under way.

    Parameters
    ----------
    link : Link
    reply : Reply
        With a number.
    timeout_s : float

    Raises
    ------
    ConnectionError
        If no telemetry comes for 5 s, or the supervisor that accepted the command no longer runs.
    """
    begun_s = heard_s = link.now_s()
    pid, found = 0, {}
    while True:
        telemetry, now_s = link.receive(RECEIVE_S), link.now_s()
        if telemetry is not None and telemetry.time_s >= reply.time_s:
            heard_s, found = now_s, _of_number(telemetry, reply.number)
            if not found or pid not in {0, telemetry.pid}:
                msg = "the supervisor that accepted the command no longer runs; see fitctl status"
                raise ConnectionError(msg)
            pid = telemetry.pid
        ended = bool(found) and all(each.state != "under way" for each in found.values())
        if ended or (found and now_s - begun_s >= timeout_s):
            return found
        if now_s - heard_s > SILENCE_S:
            msg = f"the supervisor has sent no telemetry for {SILENCE_S:g} s; see fitctl status"
            raise ConnectionError(msg)


def _of_number(telemetry: Telemetry, number: int) -> dict[str, CommandOutcome]:
    return {
        loop.name: outcome
        for loop in telemetry.loops
        for outcome in loop.outcomes
        if outcome.number == number
    }


def wait_for_end(client: Client, timeout_s: float) -> bool:
    """Wait until a supervisor that was told to end has ended; whether it has, after `timeout_s` at the latest.

    On this machine, its locks are free, so that another can start; elsewhere, it sends no telemetry and nobody
    listens at its port, or another one sends telemetry.

    Raises
    ------
    ConnectionError
        If one elsewhere sends no telemetry at the time limit, and its machine does not refuse a connection.
    """
    end_s = time.monotonic() + timeout_s
    folder, pid = client.folder, 0
    while True:
        telemetry = client.receive(RECEIVE_S)
        if telemetry is None:
            gone = client.nobody_listens() if folder is None else not supervisor_runs(folder)
        else:
            gone = folder is None and pid not in {0, telemetry.pid}
            pid = pid or telemetry.pid
        if gone:
            return True
        if time.monotonic() < end_s:
            continue
        if telemetry is None and folder is None:
            msg = f"whether the supervisor has ended is not known: {client.why_silent(timeout_s)}"
            raise ConnectionError(msg)
        return False
