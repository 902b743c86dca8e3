"""What a running instrument is doing at the moment, for rehearsals."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.supervisor import client_of
from fitctl.config import Rig
from fitctl.messages.client import Client
from fitctl.messages.telemetry import Telemetry

if TYPE_CHECKING:
    from fitctl.simulation.rehearsal import Present

LISTEN_S = 3.0


def present_of_rig(rig: Rig, remote: Path | None, command: str) -> dict[str, Present]:
    """Each loop as it is in the running instrument. Without telemetry `command` ends with status 1."""
    from fitctl.simulation.rehearsal import present_of

    client = client_of(rig, remote)
    try:
        return present_of(_messages(client))
    except ConnectionError as error:
        say(f"{command}: {error}", err=True)
        raise typer.Exit(FAILED) from None
    finally:
        client.close()


def _messages(client: Client) -> list[Telemetry]:
    """Telemetry until every loop that is not OFF had a tick, or of `LISTEN_S`.

    Raises
    ------
    ConnectionError
        If no telemetry comes.
    """
    messages: list[Telemetry] = []
    end_s = time.monotonic() + LISTEN_S
    while time.monotonic() < end_s:
        message = client.receive(0.2)
        if message is None:
            continue
        messages.append(message)
        ticked = {tick.loop for each in messages for tick in each.ticks}
        ticked |= {tick.loop for each in messages for tick in each.metrology_ticks}
        if all(loop.name in ticked or loop.mode == "OFF" for loop in message.loops):
            break
    if not messages:
        msg = f"the present state is not known: {client.why_silent(LISTEN_S)}"
        raise ConnectionError(msg)
    return messages
