"""`fitctl send`: one command to a supervisor, and its reply."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from fitctl.commands.shared import completion
from fitctl.commands.shared.options import JsonOption, RemoteOption, RigOption, SetOption
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import named_rig, require_loop, rig_of
from fitctl.commands.shared.supervisor import connect, send_and_print, send_to_all
from fitctl.commands.shared.terminal import has_terminal
from fitctl.messages.command_table import ROWS, WORDS, command_of
from fitctl.messages.commands import AnyCommand, Stop
from fitctl.messages.running import running_rigs


class SendCommand(TyperCommand):
    """Its help lists every command before the examples, from the table that all interfaces use."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Add the commands."""
        with formatter.section("Commands"):
            formatter.write_dl([(row.usage, row.help) for row in WORDS.values()])
        super().format_epilog(ctx, formatter)


# -1 is a value, not an option.
SETTINGS = {"cls": SendCommand, "context_settings": {"ignore_unknown_options": True}}


def send(
    command: Annotated[str, typer.Argument(help="One of the commands below.")],
    values: Annotated[list[str] | None, typer.Argument(help="Values of the command.")] = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    loop: Annotated[
        str,
        typer.Option(
            help="Name of one loop. [default: all loops]", autocompletion=completion.loops
        ),
    ] = "",
    wait: Annotated[
        bool | None,
        typer.Option("--wait/--no-wait", help="Wait until the command has succeeded or failed."),
    ] = None,
    timeout_s: Annotated[
        float | None,
        typer.Option("--timeout", metavar="SECONDS", min=0.1, help="Longest wait; implies --wait."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Send one command to the supervisor.

    On a terminal, fitctl waits until a command that takes time (standby, recover, acquire, off, controller,
    shutdown) has succeeded or failed. Elsewhere, it waits only with --wait.

    Exit status: 0 if the command was accepted and, with --wait, succeeded. 1 if it was refused, failed or was
    ended by another command, or if no supervisor answers. 2 for a mistake on the command line. 3 if you named
    no rig and no supervisor runs. 4 if the command is still under way after --timeout. 130 after Ctrl-C, which
    ends the waiting, not the command.
    """
    wanted = command_of(command, values or [], loop)
    if remote is None and named_rig(rig) is None and not overrides and isinstance(wanted, Stop):
        running = running_rigs()
        if len(running) > 1:
            say(f"send: {len(running)} supervisors run; stopping all of them", err=True)
            raise typer.Exit(send_to_all(running, wanted, "send", as_json=as_json))
    # `send` rejects no stop: the supervisor knows its loops, and the file may have changed since.
    if remote is None and loop and (named_rig(rig) or overrides) and not isinstance(wanted, Stop):
        described = rig_of(named_rig(rig), overrides)
        require_loop("send", described, loop, described.loops)
    client = connect("send", rig, overrides, remote)
    wait_s = _wait_s(wanted, wait, timeout_s)
    raise typer.Exit(send_and_print(client, wanted, "send", wait_s, as_json=as_json))


def _wait_s(wanted: AnyCommand, wait: bool | None, timeout_s: float | None) -> float | None:
    """How long to wait for the outcome; None for a command without an outcome, or without waiting."""
    usual_s = ROWS[type(wanted)].wait_s
    if wait is None:
        wait = timeout_s is not None or has_terminal()
    return (timeout_s or usual_s) if wait and usual_s else None
