"""A client of the supervisor that a command is for, and one command to it."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import rig_of
from fitctl.config import ConfigError, Rig
from fitctl.messages.client import Client
from fitctl.messages.commands import AnyCommand
from fitctl.messages.endpoints import service_folder
from fitctl.messages.keys import read_key_of, read_remote


def client_of(rig: Rig, remote: Path | None = None) -> Client:
    """A client of the rig's supervisor: on this machine, or where a key file for that rig leads.

    Raises
    ------
    ConfigError
        If no supervisor can be there, or the key file cannot be used or is for another rig.
    """
    return Client(service_folder(rig) if remote is None else read_key_of(rig, remote))


def connect(path: Path | None, overrides: list[str] | None, remote: Path | None) -> Client:
    """A client of the rig's supervisor on this machine, or of the one that a key file is for.

    A key file is enough by itself, and no rig file is read then; one that is given must be for the same rig.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used, or they are for different rigs.
    """
    if remote is None or path is not None:
        return client_of(rig_of(path, overrides), remote)
    if overrides:
        msg = f"--remote {remote}: --set changes a rig file; give that too, with --rig, or leave out --set"
        raise ConfigError(msg)
    return Client(read_remote(remote))


def send_and_print(client: Client, command: AnyCommand, sender: str) -> int:
    """Send one command, print the reply and close the client; returns the exit status.

    Parameters
    ----------
    client : Client
    command : AnyCommand
    sender : str
        The command of ``fitctl`` that sends it, for its error message.
    """
    try:
        reply = client.send(command)
    except ConnectionError as error:
        say(f"{sender}: {error}", err=True)
        return FAILED
    finally:
        client.close()
    wall_minus_monotonic_s = time.time() - reply.time_s
    for event in reply.events:
        stamp = datetime.fromtimestamp(event.time_s + wall_minus_monotonic_s, UTC)
        say(f"{stamp:%Y-%m-%d %H:%M:%S}  {event.severity}: {event.source}: {event.message}")
    text = reply.text or ("accepted" if reply.accepted else "refused")
    say(text, err=not reply.accepted)
    return 0 if reply.accepted else FAILED
