"""The command line: its commands in the order of ``--help``, and how a mistake in it is told."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException

from fitctl import __version__
from fitctl.commands import (
    attending,
    computing,
    describing,
    faulting,
    keys,
    log,
    reporting,
    running,
    sequence,
)
from fitctl.commands.exits import INTERRUPTED, UNUSABLE
from fitctl.commands.welcome import welcome
from fitctl.config import ConfigError

# Before numpy comes: its matrices are small here, and threads that wait for each other cost more than they
# give, above all beside a loop that must not be late.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    name="fitctl",
    help="Points starlight: acquires a star, pulls it in and holds it to a fraction of a pixel.",
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.command()(running.demo)
app.command()(running.mocks)
app.command()(describing.doctor)
app.command()(describing.discover)
app.command()(running.run)
app.command()(attending.console)
app.command(
    cls=attending.SendCommand,
    context_settings={"ignore_unknown_options": True},  # -1 is a value
)(attending.send)
app.command()(attending.status)
app.command()(attending.watch)
app.command()(computing.simulate)
app.command()(computing.replay)
app.command()(computing.identify)
app.command()(computing.design)
app.command()(computing.figures)
app.command()(describing.init)
app.command()(reporting.report)
app.command()(reporting.plot)
app.command()(describing.check)
app.command(hidden=True)(running.record)
app.command(hidden=True)(running.metrics)
app.command(hidden=True)(running.gateway)
app.add_typer(faulting.app, name="fault")
app.add_typer(log.app, name="log")
app.add_typer(sequence.app, name="sequence")
app.add_typer(keys.app, name="keys")


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fitctl {__version__}")
        raise typer.Exit


@app.callback()
def _of_all_commands(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="Say which this is."),
    ] = False,
) -> None:
    """Nothing: it has the options that stand before a command."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point: what an operator can mend is one line for each thing, and exit status 2."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given and "_FITCTL_COMPLETE" not in os.environ:
        typer.echo(welcome(Path.cwd()))
        return
    try:
        status = app(given, prog_name="fitctl", standalone_mode=False)
    except ConfigError as error:
        typer.echo(str(error), err=True)
        status = UNUSABLE
    except TyperException as error:
        context = getattr(error, "ctx", None)
        command = "fitctl" if context is None else context.command_path
        typer.echo(f"{command}: {_message(error)} (see {command} --help)", err=True)
        status = UNUSABLE
    except (KeyboardInterrupt, typer.Abort):
        status = INTERRUPTED
    sys.exit(status)


def _message(error: TyperException) -> str:
    """The error as one line, with the option that it is about."""
    format_message = getattr(error, "format_message", None)
    text = str(error) if format_message is None else format_message()
    return text.replace("\n", " ").rstrip(".")
