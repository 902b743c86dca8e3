"""A command to a supervisor, and its answer."""

from __future__ import annotations

import typer

from fitctl.commands.exits import FAILED
from fitctl.supervisor.client import Client
from fitctl.supervisor.messages import AnyCommand


def give(client: Client, command: AnyCommand, said_by: str) -> int:
    """Give one command, print the answer and let go of the client; returns the exit status."""
    try:
        reply = client.send(command)
    except ConnectionError as error:
        typer.echo(f"{said_by}: {error}", err=True)
        return FAILED
    finally:
        client.close()
    answer = reply.text or ("accepted" if reply.accepted else "refused")
    typer.echo(answer, err=not reply.accepted)
    return 0 if reply.accepted else FAILED
