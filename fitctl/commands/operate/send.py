"""`fitctl send`: one command to a supervisor, and its reply."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from fitctl.commands.shared import completion
from fitctl.commands.shared.options import RemoteOption, RigOption, SetOption
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import named_rig, require_loop, rig_of
from fitctl.commands.shared.supervisor import connect, send_and_print, send_to_all
from fitctl.messages.command_table import WORDS, command_of
from fitctl.messages.commands import Stop
from fitctl.messages.running import running_rigs


class SendCommand(TyperCommand):
    """Its help ends with every command, from the table that they are made from."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Add them."""
        with formatter.section("Commands"):
            formatter.write_dl([(row.usage, row.help) for row in WORDS.values()])


# -1 is a value, not an option.
SETTINGS = {"cls": SendCommand, "context_settings": {"ignore_unknown_options": True}}


def send(
    command: Annotated[str, typer.Argument(help="One of those below.")],
    values: Annotated[list[str] | None, typer.Argument(help="What it needs.")] = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    loop: Annotated[
        str,
        typer.Option(help="One loop by name; without it, all.", autocompletion=completion.loops),
    ] = "",
) -> None:
    """Give one command to the running supervisor of a rig."""
    wanted = command_of(command, values or [], loop)
    if remote is None and named_rig(rig) is None and not overrides and isinstance(wanted, Stop):
        running = running_rigs()
        if len(running) > 1:
            say(f"send: {len(running)} supervisors run; stopping all of them", err=True)
            raise typer.Exit(send_to_all(running, wanted, "send"))
    if remote is None and loop and (named_rig(rig) or overrides):
        require_loop("send", rig_of(named_rig(rig), overrides), loop)
    raise typer.Exit(send_and_print(connect("send", rig, overrides, remote), wanted, "send"))
