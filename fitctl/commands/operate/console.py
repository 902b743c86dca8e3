"""`fitctl console`: an operator console, in the terminal or in a browser."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated, Literal

import typer

from fitctl.commands.operate.web import serve_console
from fitctl.commands.shared.options import RemoteOption, RigOption, SetOption
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address, connect
from fitctl.commands.shared.terminal import has_terminal
from fitctl.config import ConfigError
from fitctl.processes import rig_arguments
from fitctl.tui.app import ConsoleApp
from fitctl.tui.graphics import Graphics, graphics_of

_NICENESS = 5
_NO_TERMINAL = (
    "console: needs a terminal for input, output and error output. Without one, use fitctl watch, "
    "fitctl status, or fitctl console --web for a browser"
)


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
    # A browser's page runs this command too, with a driver of textual-serve in place of a terminal.
    if not (web or "TEXTUAL_DRIVER" in os.environ or has_terminal()):
        raise ConfigError(_NO_TERMINAL)
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
        serve_console([*(arguments or ()), *remote_arguments], port)
        return
    # The logs of a rig elsewhere are elsewhere too.
    log_folder = None if remote else Path(rig_of(rig, overrides).logging.folder).expanduser()
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
