"""`fitctl rig`: rig files of older versions, written for this one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import JsonOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.config import ConfigError
from fitctl.config.rig import SCHEMA_VERSION
from fitctl.config.upgrade import upgrade as upgraded

app = typer.Typer(help="Upgrade rig files of older versions.")


@app.callback()
def _rig() -> None:
    """Upgrade rig files of older versions."""


@app.command()
def upgrade(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="Rig file of an older version.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Rig file to write. [default: OLD.vN.toml beside OLD]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a new rig file from an older one.

    Prints each change. Values and comments of OLD stay, and OLD itself is not changed. New keys get the values
    of the shipped rig: read them before you use the file. Exit status 1 if you must correct something by hand.
    """
    if out is not None and out.absolute().parent != old.absolute().parent:
        msg = f"--out {out}: must be in the folder of {old}, because a rig file names others beside it"
        raise ConfigError(msg)
    result = upgraded(old)
    new = out or old.with_suffix(f".v{SCHEMA_VERSION}.toml")  # what has no name was no file
    try:
        with new.open("x", encoding="utf-8") as file:
            file.write(result.text)
    except OSError as error:
        msg = f"{new}: cannot be written: {error.strerror}; name another file with --out"
        raise ConfigError(msg) from None
    if as_json:
        changes = [change._asdict() for change in result.changes]
        document = {"old": str(old), "new": str(new), "changes": changes}
        say(to_json(document | {"problems": result.problems}))
        raise typer.Exit(FAILED if result.problems else 0)
    for change in result.changes:
        say(f"  {change.key} = {change.value}  # {f'was {change.was}' if change.was else 'new'}")
    say(f"{new}: written, with {len(result.changes)} changes")
    if result.problems:
        say("To correct by hand:", err=True)
        for problem in result.problems:
            say(f"  {problem.replace(str(old), str(new), 1)}", err=True)
        raise typer.Exit(FAILED)
    say(f"Next: fitctl check {new} --show")
