"""The command line: its commands in the order of ``--help``, and how a mistake in it is reported."""

from __future__ import annotations

import errno
import importlib
import os
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

from fitctl import __version__
from fitctl.commands.shared.examples import EXAMPLES
from fitctl.commands.shared.exits import FAILED, INTERRUPTED, UNUSABLE
from fitctl.commands.shared.printing import say, say_lines
from fitctl.commands.shared.welcome import welcome

# Before numpy comes: its matrices are small here, and threads that wait for each other cost more than they
# give, above all beside a loop that must not be late.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class Command(NamedTuple):
    """Where a command's module is, and its line in ``--help``.

    Attributes
    ----------
    group : str
        The module is ``fitctl.commands.GROUP.NAME``.
    summary : str
        At most 45 characters. Empty for a command that people do not need; ``--help`` omits it.
    """

    group: str
    summary: str = ""


# The headings of ``--help``, in order.
GROUPS = {
    "try_out": "Try",
    "set_up": "Set up",
    "operate": "Operate",
    "analyse": "Analyse",
    "design": "Design",
}
COMMANDS = {
    "demo": Command("try_out", "Run the whole instrument on mock devices"),
    "mocks": Command("try_out", "Serve the mock devices of a rig"),
    "fault": Command("try_out", "Inject faults into running mocks"),
    "init": Command("set_up", "Write a rig file for your hardware"),
    "check": Command("set_up", "Validate a rig file"),
    "rig": Command("set_up", "Upgrade rig files of older versions"),
    "discover": Command("set_up", "List cameras, serial ports and CAN interfaces"),
    "doctor": Command("set_up", "Check that the devices of a rig answer"),
    "commission": Command("set_up", "Prove a rig step by step, from wiring to star"),
    "keys": Command("set_up", "Manage keys for remote access"),
    "run": Command("operate", "Supervise a rig"),
    "console": Command("operate", "Open the operator console"),
    "status": Command("operate", "Show the state of the instrument"),
    "watch": Command("operate", "Print a line a second, and every event"),
    "send": Command("operate", "Send one command to the supervisor"),
    "rehearse": Command("operate", "Show what a command would do"),
    "sequence": Command("operate", "Run, check and steer sequences of steps"),
    "report": Command("analyse", "Make a report of a night from its logs"),
    "plot": Command("analyse", "Plot fields of a log in the terminal"),
    "log": Command("analyse", "Inspect, repair and convert logs"),
    "replay": Command("analyse", "Run the frames of a log through today's code"),
    "simulate": Command("design", "Acquire and hold a star on a virtual clock"),
    "identify": Command("design", "Measure the parameters of a rig"),
    "design": Command("design", "Design the controllers of a loop"),
    "figures": Command("design", "Make the paper's figures from this system"),
    "record": Command("processes"),
    "metrics": Command("processes"),
    "gateway": Command("processes"),
    "learner": Command("processes"),
}


def load_command(name: str) -> Any:
    """The command with its options and examples; imports its module, which may take a second."""
    module = importlib.import_module(f"fitctl.commands.{COMMANDS[name].group}.{name}")
    alone = typer.Typer(rich_markup_mode=None)
    if hasattr(module, "app"):
        alone.add_typer(module.app, name=name)
    else:
        alone.command(name, **getattr(module, "SETTINGS", {}))(getattr(module, name))
    command = typer.main.get_group(alone).commands[name]
    _add_examples(command, name)
    return command


def _add_examples(command: Any, path: str) -> None:
    """End the help of a command, and of each command below it, with its examples."""
    if path in EXAMPLES:
        # A paragraph that begins with \b is not rewrapped.
        command.epilog = "\n".join(("\b", "Examples:", *(f"  {each}" for each in EXAMPLES[path])))
    for name, below in getattr(command, "commands", {}).items():
        _add_examples(below, f"{path} {name}")


class LazyGroup(TyperGroup):
    """Lists commands from the table, and loads the one that the command line names."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = {
            name: TyperCommand(name, short_help=command.summary, hidden=not command.summary)
            for name, command in COMMANDS.items()
        }

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find the command that the arguments name, for its run, its help and its completion."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, None if command is None else load_command(str(command.name)), rest

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands under the headings of their groups, in one column."""
        width = max(map(len, COMMANDS))
        for group, heading in GROUPS.items():
            listed = [
                (name.ljust(width), command.summary)
                for name, command in COMMANDS.items()
                if command.group == group
            ]
            with formatter.section(heading):
                formatter.write_dl(listed)


app = typer.Typer(
    name="fitctl",
    cls=LazyGroup,
    help="Acquire a star, pull it in, and hold it to a fraction of a pixel.",
    epilog="Run fitctl COMMAND --help for the options of a command, with examples.",
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        say(f"fitctl {__version__}")
        raise typer.Exit


@app.callback()
def _of_all_commands(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Nothing: it has the options that stand before a command."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point: what an operator can mend is one line for each thing, and exit status 2."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given and "_FITCTL_COMPLETE" not in os.environ:
        say_lines(welcome(Path()))
        return
    try:
        status = app(given, prog_name="fitctl", standalone_mode=False)
    except TyperException as error:
        context = getattr(error, "ctx", None)
        named = f"fitctl {given[0]}" if given[:1] and given[0] in COMMANDS else "fitctl"
        command = named if context is None else context.command_path
        say(f"{command}: {_message(error)} (see {command} --help)", err=True)
        status = UNUSABLE
    except (KeyboardInterrupt, typer.Abort):
        status = INTERRUPTED
    except Exception as error:
        # Not at the top: `fitctl --help` and Tab need no rig file, and take half the time without.
        from fitctl.config import ConfigError
        from fitctl.logging.errors import LogError

        if isinstance(error, OSError) and error.errno in _FULL and error.filename is None:
            _end_output(f"fitctl: its output cannot be written: {error.strerror}")
        if not isinstance(error, ConfigError | LogError):
            raise
        # A rig file's error has a line for each thing that is wrong; a log's is of one line.
        (say_lines if isinstance(error, ConfigError) else say)(str(error), err=True)
        status = UNUSABLE
    sys.exit(status or 0)


def _end_output(why: str) -> NoReturn:
    """End because a disk is full; what is still in the buffer must not fail once more at the exit."""
    say(f"{why}; free some space, or direct it to another disk", err=True)
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(FAILED)


def _message(error: TyperException) -> str:
    """The error as one line, with the option that it is about."""
    format_message = getattr(error, "format_message", None)
    text = str(error) if format_message is None else format_message()
    context = getattr(error, "ctx", None)
    if text == "Missing command." and context is not None:
        text = f"expected a command: {', '.join(context.command.commands)}"
    text, _, possible = text.partition(" (Possible options: ")
    if possible:
        text += f"; did you mean {possible.rstrip(')').replace(', ', ' or ')}?"
    text = text.replace("Input should be", "expected").replace("Value error, ", "")
    return text.replace("\n", " ").rstrip(".")
