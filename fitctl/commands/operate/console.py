"""`fitctl console`: an operator console, in the terminal or in a browser."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from fitctl.commands.operate.logged_loops import loops_at_start
from fitctl.commands.operate.web import serve_console
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.logs import LatestOption, chosen_log
from fitctl.commands.shared.options import RemoteOption, RigOption, SetOption
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address, client_of, connect
from fitctl.commands.shared.terminal import has_terminal
from fitctl.config import ConfigError
from fitctl.logging.errors import LogError
from fitctl.processes import give_way, rig_arguments
from fitctl.tui.app import ConsoleApp
from fitctl.tui.graphics import Graphics, graphics_of
from fitctl.tui.rewind.logged import LoggedRun
from fitctl.tui.wire import NoLink

_NICENESS = 5
_WEB_PORT = 8000
_NO_TERMINAL = (
    "console: needs a terminal for input, output and error output. Without one, use fitctl watch, "
    "fitctl status, or fitctl console --web for a browser"
)


def console(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    quitting_ends_instrument: Annotated[
        bool, typer.Option("--quitting-ends-instrument", hidden=True, help="Shown in its help.")
    ] = False,
    graphics: Annotated[
        Literal["auto", "half-blocks", "sixel", "kitty"],
        typer.Option(
            envvar="FITCTL_GRAPHICS", help="How to draw the focal plane; auto depends on TERM."
        ),
    ] = "auto",
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="LOG", help="Show a log instead of a running instrument."),
    ] = None,
    latest: LatestOption = False,
    web: Annotated[
        bool, typer.Option("--web", help="Open the console in a browser on this machine.")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535,
            show_default=str(_WEB_PORT),
            help="Port of --web, on 127.0.0.1.",
        ),
    ] = None,
) -> None:
    """Open the operator console on a running supervisor.

    With --remote, also name the rig file with --rig if you need sequences and the margins on the screen Loop.
    With --log or --latest, the console shows a log: it needs no supervisor and sends no commands.
    """
    if port is not None and not web:
        msg = f"console: --port {port} is for --web; add --web, or leave out --port"
        raise ConfigError(msg)
    # A browser's page runs this command too, with a driver of textual-serve in place of a terminal.
    if not (web or "TEXTUAL_DRIVER" in os.environ or has_terminal()):
        raise ConfigError(_NO_TERMINAL)
    if latest or log is not None:
        _show_log(chosen_log("console", log, rig, latest=latest), remote, graphics, web=web)
        return
    arguments: list[str] | None = None  # what the shipped file says is not true of a rig elsewhere
    if remote is None:
        found = address("console", rig, overrides)
        rig, overrides = found.file, found.settings
    if rig is not None:
        arguments = rig_arguments(rig, overrides or ())
    remote_arguments = ["--remote", str(remote)] if remote else []
    client = connect("console", rig, overrides, remote)
    if web:
        client.close()  # what is wrong with the rig is said here, not in the browser
        serve_console([*(arguments or ()), *remote_arguments], port or _WEB_PORT)
        return
    # The logs of a rig elsewhere are elsewhere too.
    log_folder = None if remote else rig_of(rig, overrides).logging.folder_path
    app = ConsoleApp(
        client,
        quit_shuts_down=quitting_ends_instrument,
        clock=client.now_s,
        rig_arguments=arguments,
        remote_arguments=remote_arguments,
        log_folder=log_folder,
        graphics=graphics_of(Graphics(graphics), os.environ),
    )
    _run(app)


def commissioning_console(rig: Path, overrides: Sequence[str], options: Sequence[str]) -> None:
    """A console that runs the steps of a commissioning; it waits for a supervisor only while a step has one.

    Parameters
    ----------
    rig : Path
    overrides : sequence of str
        As of ``--set``.
    options : sequence of str
        Other options of ``fitctl commission``.

    Raises
    ------
    ConfigError
        If there is no terminal.
    """
    if not has_terminal():
        raise ConfigError(_NO_TERMINAL)
    described = rig_of(rig, list(overrides))
    client, arguments = client_of(described), rig_arguments(rig, overrides)
    app = ConsoleApp(
        client,
        clock=client.now_s,
        rig_arguments=arguments,
        commissioning=[*arguments, *options],
        log_folder=described.logging.folder_path,
        graphics=graphics_of(Graphics("auto"), os.environ),
    )
    _run(app, niceness=0)  # a step inherits it, and points the star


def _show_log(log: Path, remote: Path | None, graphics: str, *, web: bool) -> None:
    """A console of what was; nothing is attached."""
    if web or remote is not None:
        msg = "console: --log shows a file on this machine in this terminal; leave out --web and --remote"
        raise ConfigError(msg)
    try:
        recording = LoggedRun(log, loops_at_start)
    except LogError as error:
        raise ConfigError(str(error)) from error
    app = ConsoleApp(
        NoLink(),
        rig_arguments=None,
        log_folder=log.parent,
        graphics=graphics_of(Graphics(graphics), os.environ),
        log=recording,
        log_name=log.name,
    )
    _run(app)


def _run(app: ConsoleApp, niceness: int = _NICENESS) -> None:
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: app.exit())  # leaves the terminal as it was, and no folder
    # Whatever points the star goes first. What the console starts gives way as well: a sequence, too, only
    # asks the supervisor for what that then does in its own time.
    give_way(niceness)
    app.run()
    if app.return_code:  # Textual has printed why it ended
        raise typer.Exit(FAILED)
