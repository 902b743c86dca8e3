"""Who may send commands: roles, and the lease that one person has at a time."""

from __future__ import annotations

from typing import NamedTuple

from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import AnyCommand, TakeOver
from fitctl.messages.keys import Role


class Sender(NamedTuple):
    """Who sent something, and from where.

    Attributes
    ----------
    name : str
        Of the key; of somebody on this machine, USER@HOST.
    address : str
        Of the machine; on this machine, of the process.
    role : str
    is_local : bool
        It came by the Unix socket.
    """

    name: str
    address: str
    role: Role
    is_local: bool


class Admission:
    """Decides who may give which command; for the service's thread alone.

    The lease belongs to a person, not to a process: to a key's name, or to a local user.

    Parameters
    ----------
    lease_s : float
        Its holder loses it after this silence.
    """

    def __init__(self, lease_s: float) -> None:
        self._lease_s = lease_s
        self._holder = ""
        self._heard_s = 0.0

    def commander(self, now_s: float) -> str:
        """The person who has the lease; empty if there is none."""
        return self._holder if now_s - self._heard_s <= self._lease_s else ""

    def release(self, name: str) -> None:
        """Take the lease from a person whose key was revoked."""
        if self._holder == name:
            self._holder = ""

    def refusal(self, sender: Sender, command: AnyCommand, now_s: float) -> str:
        """Why this command is not taken; empty when it is, and then the sender has what it needs."""
        needs = ROWS[type(command)].needs
        if needs == "the Unix socket" and not sender.is_local:
            return f"{type(command).__name__} is accepted only on the rig's own machine"
        if needs in {"a commander's key", "the instrument"} and sender.role != "commander":
            return f"the key {sender.name} can watch but not command; ask the rig's owner for a commander's key"
        holder = self.commander(now_s)
        if needs == "the instrument" and holder not in {"", sender.name}:
            return f"{holder} has the instrument; to take it over: fitctl send take-over"
        if needs == "the instrument" or isinstance(command, TakeOver):
            self._holder, self._heard_s = sender.name, now_s
        elif holder == sender.name and needs != "the Unix socket":
            # Recorder and learner report by themselves, under the name of the user who started them.
            self._heard_s = now_s
        return ""
