"""A command to a supervisor, and its answer."""

from __future__ import annotations

import time
from datetime import UTC, datetime

import typer

from fitctl.commands.exits import FAILED
from fitctl.logging.records import Event
from fitctl.messages.client import Client
from fitctl.messages.commands import AnyCommand


def give(client: Client, command: AnyCommand, said_by: str) -> int:
    """Give one command, print the answer and let go of the client; returns the exit status."""
    try:
        reply = client.send(command)
    except ConnectionError as error:
        typer.echo(f"{said_by}: {error}", err=True)
        return FAILED
    finally:
        client.close()
    for event in reply.events:
        typer.echo(_event_line(event, time.time() - reply.time_s))
    answer = reply.text or ("accepted" if reply.accepted else "refused")
    typer.echo(answer, err=not reply.accepted)
    return 0 if reply.accepted else FAILED


def _event_line(event: Event, wall_minus_monotonic_s: float) -> str:
    stamp = datetime.fromtimestamp(event.time_s + wall_minus_monotonic_s, UTC)
    return f"{stamp:%Y-%m-%d %H:%M:%S}  {event.severity}: {event.source}: {event.message}"
