"""Command lines of what attaches to a running instrument: console, send, status, watch."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from fitctl.commands import completing
from fitctl.commands.choosing import connect, insist_on_loop, rig_of
from fitctl.commands.options import JsonOption, RemoteOption, RigOption, SetOption
from fitctl.config import default_rig_path
from fitctl.processes import rig_arguments

_NICENESS = 5


def console(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    quitting_ends_instrument: Annotated[
        bool, typer.Option("--quitting-ends-instrument", hidden=True, help="Said in its help.")
    ] = False,
    graphics: Annotated[
        Literal["auto", "half-blocks", "sixel", "kitty"],
        typer.Option(
            envvar="FITCTL_GRAPHICS", help="How the focal plane is drawn; auto goes by TERM."
        ),
    ] = "auto",
    web: Annotated[bool, typer.Option("--web", help="In a browser on this machine.")] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of --web, on 127.0.0.1.")] = 8000,
) -> None:
    """Attach an operator console to the running supervisor of a rig.

    With --remote, the margins of screen Loop and the sequences need that rig's own file too, with --rig.
    """
    arguments: list[str] | None = None  # what the shipped file says is not true of a rig elsewhere
    if rig is not None or remote is None:
        arguments = rig_arguments(rig or default_rig_path(), overrides or ())
    remote_arguments = ["--remote", str(remote)] if remote else []
    client = connect(rig, overrides, remote)
    if web:
        from fitctl.commands.web import serve_console

        client.close()  # what is wrong with the rig is said here, not in the browser
        serve_console([*(arguments or ()), *remote_arguments], port)
        return
    # The logs of a rig elsewhere are elsewhere too.
    log_folder = None if remote else Path(rig_of(rig, overrides).logging.folder).expanduser()
    from fitctl.tui.app import ConsoleApp
    from fitctl.tui.graphics import Graphics, graphics_of

    app = ConsoleApp(
        client,
        quit_shuts_down=quitting_ends_instrument,
        clock=client.now_s,
        rig_arguments=arguments,
        remote_arguments=remote_arguments,
        log_folder=log_folder,
        graphics=graphics_of(Graphics(graphics), os.environ),
    )
    signal.signal(signal.SIGTERM, lambda *_: app.exit())  # leaves the terminal as it was
    # Whatever points the star goes first. What the console starts gives way as well: a sequence, too, only
    # asks the supervisor for what that then does in its own time.
    os.nice(_NICENESS)
    app.run()


class SendCommand(TyperCommand):
    """Its help ends with every command, from the table that they are made from."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Add them."""
        from fitctl.messages.command_table import WORDS

        with formatter.section("Commands"):
            formatter.write_dl([(row.usage, row.help) for row in WORDS.values()])


def send(
    command: Annotated[str, typer.Argument(help="One of those below.")],
    values: Annotated[list[str] | None, typer.Argument(help="What it needs.")] = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    loop: Annotated[
        str,
        typer.Option(help="One loop by name; without it, all.", autocompletion=completing.loops),
    ] = "",
) -> None:
    """Give one command to the running supervisor of a rig."""
    from fitctl.commands.send import give
    from fitctl.messages.command_table import command_of

    wanted = command_of(command, values or [], loop)
    if remote is None and loop:
        insist_on_loop("send", rig_of(rig, overrides), loop)
    raise typer.Exit(give(connect(rig, overrides, remote), wanted, "send"))


def status(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say how the running instrument of a rig is.

    Exit status 0 if all is well, 1 if something is not, 3 if no supervisor answers.
    """
    from fitctl.commands.status import run_status

    raise typer.Exit(run_status(connect(rig, overrides, remote), as_json=as_json))


def watch(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Each line is one JSON object; `kind` says what of.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(min=0.1, metavar="SECONDS", help="Without it, until Ctrl-C.")
    ] = None,
) -> None:
    """Print a line a second about the running instrument, and every event as it comes."""
    from fitctl.commands.watch import run_watch

    raise typer.Exit(run_watch(connect(rig, overrides, remote), duration, as_json=as_json))
