"""The operator's commands: one table for keys, footer, palette and help."""

from __future__ import annotations

from typing import NamedTuple

from fitctl.supervisor.messages import Acquire, Hold, Off, Recover, Standby, Stop

KeyCommand = Standby | Acquire | Hold | Stop | Recover | Off


class OperatorCommand(NamedTuple):
    """A command on a key."""

    key: str
    label: str
    make: type[KeyCommand]
    help: str

    @property
    def name(self) -> str:
        """As ``LoopState.usable_commands`` calls it."""
        return self.make.__name__


OPERATOR_COMMANDS = (
    OperatorCommand("s", "STOP", Stop, "SAFE, at once, from every mode"),
    OperatorCommand("b", "Standby", Standby, "from OFF: connect and enable all devices"),
    OperatorCommand("a", "Acquire", Acquire, "search for the star, pull it in, hold it"),
    OperatorCommand("h", "Hold", Hold, "stop tracking where the stages are"),
    OperatorCommand("r", "Recover", Recover, "from SAFE: reconnect, reset faults, then STANDBY"),
    OperatorCommand("o", "Off", Off, "from STANDBY or SAFE: disable amplifiers, let go of devices"),
)
BY_NAME = {command.name: command for command in OPERATOR_COMMANDS}
