"""A client of the supervisor that a command is for, and one command to it."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import typer
from msgspec.structs import asdict

from fitctl.commands.shared.exits import FAILED, INTERRUPTED, NO_SUPERVISOR, STILL_UNDER_WAY
from fitctl.commands.shared.printing import datetime_of, say, to_json
from fitctl.commands.shared.rig import named_rig, rig_of
from fitctl.config import ConfigError, Rig, default_rig_path
from fitctl.messages.client import Client
from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import AnyCommand, Reply, Shutdown, Stop
from fitctl.messages.endpoints import service_folder
from fitctl.messages.keys import read_key_of, read_remote
from fitctl.messages.running import RunningRig, only_running_rig, running_rig
from fitctl.messages.telemetry import CommandOutcome
from fitctl.messages.waiting import wait_for_end, wait_for_outcomes
from fitctl.processes import ended_by_signals, interrupt


class Addressed(NamedTuple):
    """The rig that a command addresses: its file, what replaces values of it, its supervisor if found."""

    file: Path
    settings: list[str]
    running: RunningRig | None = None


def address(command: str, path: Path | None, overrides: list[str] | None) -> Addressed:
    """Find the rig that a command addresses: ``--rig``, ``FITCTL_RIG``, or the one supervisor that runs.

    ``--set`` by itself changes the shipped rig file.

    Raises
    ------
    ConfigError
        If several run; the text names them.
    typer.Exit
        If none runs, with one line.
    """
    found = _address(command, path, overrides)
    if found is None:
        say(
            f"{command}: you have no supervisor running on this machine; start one with fitctl run --rig FILE, "
            "or everything on mocks with fitctl demo, or name a rig with --rig or FITCTL_RIG",
            err=True,
        )
        raise typer.Exit(NO_SUPERVISOR)
    return found


def address_or_shipped(command: str, path: Path | None, overrides: list[str] | None) -> Addressed:
    """As :func:`address`, but the shipped rig where no supervisor runs: for what needs none.

    Raises
    ------
    ConfigError
        If several run; the text names them.
    """
    return _address(command, path, overrides) or Addressed(default_rig_path(), [])


def _address(command: str, path: Path | None, overrides: list[str] | None) -> Addressed | None:
    named = named_rig(path)
    if named is not None or overrides:
        return Addressed(named or default_rig_path(), overrides or [])
    running = only_running_rig(command)
    return None if running is None else Addressed(Path(running.file), running.settings, running)


def show_rig(name: str, where: str) -> None:
    """Print which rig a command addresses; on the error output, so that results stay alone."""
    say(f"rig {name}: {where}", err=True)


def client_of(rig: Rig, remote: Path | None = None) -> Client:
    """A client of the rig's supervisor: on this machine, or where a key file for that rig leads.

    Raises
    ------
    ConfigError
        If no supervisor can be there, or the key file cannot be used or is for another rig.
    """
    return Client(service_folder(rig) if remote is None else read_key_of(rig, remote))


def connect(
    command: str, path: Path | None, overrides: list[str] | None, remote: Path | None
) -> Client:
    """A client of the supervisor that a command addresses, here or where a key file leads; prints which.

    A key file is enough by itself, and no rig file is read then; one that is given must be for the same rig.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used, or they are for different rigs.
    """
    if remote is None:
        found = address(command, path, overrides)
        if found.running is not None:
            show_rig(found.running.name, f"{found.file} (running)")
            return Client(Path(found.running.folder))
        rig = rig_of(found.file, found.settings)
        show_rig(rig.name, str(found.file))
        return client_of(rig)
    if path is not None:
        rig = rig_of(path, overrides)
        client = client_of(rig, remote)
        show_rig(rig.name, f"{path}, by the key {remote}")
        return client
    if overrides:
        msg = f"--remote {remote}: --set changes a rig file; give that too, with --rig, or leave out --set"
        raise ConfigError(msg)
    key = read_remote(remote)
    show_rig(key.rig, f"at {key.host}, by the key {remote}")
    return Client(key)


def send_and_print(
    client: Client,
    command: AnyCommand,
    sender: str,
    wait_s: float | None = None,
    *,
    as_json: bool = False,
) -> int:
    """Send one command, print the reply and close the client; returns the exit status.

    With `wait_s`, the command is followed for so long, and its outcome decides the exit status.

    Parameters
    ----------
    client : Client
    command : AnyCommand
    sender : str
        The command of ``fitctl`` that sends it, for its error message.
    wait_s : float, optional
    as_json : bool
        Print one JSON object: the reply, and with `wait_s` the ``outcomes`` by loop, or whether it ``ended``.
    """
    try:
        reply = _reply(client, command)
        waits = wait_s is not None and isinstance(reply, Reply) and reply.accepted
        status = 0 if as_json and waits else print_reply(reply, sender, as_json=as_json)
        if wait_s is None or not isinstance(reply, Reply) or not reply.accepted:
            return status
        return _wait_and_print(client, command, reply, sender, wait_s, as_json=as_json)
    finally:
        client.close()


def _wait_and_print(
    client: Client, command: AnyCommand, reply: Reply, sender: str, wait_s: float, *, as_json: bool
) -> int:
    """Wait for the outcome of an accepted command, print it, a line for each loop; returns the exit status."""
    word = ROWS[type(command)].word
    say(f"waiting {wait_s:g} s at most; Ctrl-C ends the waiting, not the command", err=True)
    try:
        with ended_by_signals(interrupt):
            if isinstance(command, Shutdown):
                ended = wait_for_end(client, wait_s)
                if as_json:
                    say(to_json(asdict(reply) | {"ended": ended}))
                    return 0 if ended else STILL_UNDER_WAY
                return _print_end(ended, wait_s)
            found = wait_for_outcomes(client, reply, wait_s)
    except ConnectionError as error:
        say(f"{sender}: {error}", err=True)
        return FAILED
    except KeyboardInterrupt:
        say(f"{sender}: no longer waiting; {word} continues. See: fitctl status", err=True)
        return INTERRUPTED
    if as_json:
        say(to_json(asdict(reply) | {"outcomes": found}))
    for loop, outcome in () if as_json else found.items():
        say(_outcome_text(loop, outcome, wait_s), err=outcome.state != "done")
    return max(_EXITS[outcome.state] for outcome in found.values())


def _print_end(ended: bool, wait_s: float) -> int:
    text = "the supervisor has ended" if ended else f"the supervisor still runs after {wait_s:g} s"
    say(text, err=not ended)
    return 0 if ended else STILL_UNDER_WAY


def _outcome_text(loop: str, outcome: CommandOutcome, wait_s: float) -> str:
    took_s = outcome.ended_s - outcome.began_s
    match outcome.state:
        case "done":
            return f"{loop} {outcome.text} (after {took_s:.1f} s)"
        case "under way":
            return (
                f"{loop}: {outcome.command} is still under way after {wait_s:g} s, and continues. "
                "See: fitctl status"
            )
        case "failed":
            return f"{loop}: {outcome.command} failed after {took_s:.1f} s: {outcome.text}"
        case "ended":
            return f"{loop}: {outcome.command} ended after {took_s:.1f} s: {outcome.text}"


_EXITS = {"done": 0, "failed": FAILED, "ended": FAILED, "under way": STILL_UNDER_WAY}


def send_to_all(
    running: list[RunningRig], command: AnyCommand, sender: str, *, as_json: bool
) -> int:
    """Send one command to several supervisors at once and print each reply; returns the exit status."""
    with ThreadPoolExecutor(len(running)) as threads:
        replies = list(threads.map(lambda rig: _reply_of(rig, command), running))
    statuses = []
    for rig, reply in zip(running, replies, strict=True):
        show_rig(rig.name, f"{rig.file} (process {rig.pid})")
        statuses.append(print_reply(reply, sender, as_json=as_json))
    return max(statuses)


def _reply_of(rig: RunningRig, command: AnyCommand) -> Reply | ConnectionError:
    client = Client(Path(rig.folder))
    try:
        return _reply(client, command)
    finally:
        client.close()


def _reply(client: Client, command: AnyCommand) -> Reply | ConnectionError:
    try:
        return client.send(command)
    except ConnectionError as error:
        if isinstance(command, Stop) and (client.folder is None or running_rig(client.folder)):
            return ConnectionError(f"{error}; the instrument may still move: cut its power")
        return error


def print_reply(reply: Reply | ConnectionError, sender: str, *, as_json: bool) -> int:
    """Print a reply, or why there is none; returns the exit status."""
    if isinstance(reply, ConnectionError):
        say(f"{sender}: {reply}", err=True)
        return FAILED
    if as_json:
        say(to_json(reply))
        return 0 if reply.accepted else FAILED
    wall_minus_monotonic_s = time.time() - reply.time_s
    for event in reply.events:
        stamp = datetime_of(event.time_s + wall_minus_monotonic_s)
        when = "at no time" if stamp is None else f"{stamp:%Y-%m-%d %H:%M:%S}"
        say(f"{when}  {event.severity}: {event.source}: {event.message}")
    text = reply.text or ("accepted" if reply.accepted else "refused")
    say(text, err=not reply.accepted)
    return 0 if reply.accepted else FAILED
