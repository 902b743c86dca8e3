"""`fitctl keys`: who may reach a rig from other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.shared.options import JsonOption, OwnRigOption, SetOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import named_rig, rig_of
from fitctl.messages.keys import allowed_keys, new_key, revoke_key

app = typer.Typer(
    help="Manage keys for remote access.",
)

NameArgument = Annotated[str, typer.Argument(help="Name of the person: a-z, 0-9, - and _.")]


@app.command()
def new(
    name: NameArgument,
    viewer: Annotated[
        bool, typer.Option("--viewer", help="Allow watching only, no commands.")
    ] = False,
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Address of this machine. [default: service.tcp_address]",
        ),
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Key file to write. [default: NAME.key.toml]"),
    ] = None,
    rig: OwnRigOption = None,
    overrides: SetOption = None,
) -> None:
    """Allow a person in, and write their key file.

    Anyone who holds the key file can act as that person.
    """
    settings = rig_of(named_rig(rig), overrides)
    path = out or Path(f"{name}.key.toml")
    key = new_key(settings, name, "viewer" if viewer else "commander", host, path)
    say(f"{path}: {key.role} {key.name} of rig {key.rig} at {key.host}; hand it over in secret")
    if not settings.service.tcp_address:
        say("the rig accepts no remote connections yet: set service.tcp_address and restart it")


@app.command("list")
def list_(
    rig: OwnRigOption = None, overrides: SetOption = None, as_json: JsonOption = False
) -> None:
    """List the allowed keys and their roles."""
    keys, problems = allowed_keys(rig_of(named_rig(rig), overrides))
    if as_json:
        say(to_json([{"name": k.name, "role": k.role, "public": k.public} for k in keys.values()]))
    for key in () if as_json else keys.values():
        say(f"{key.name:<32}  {key.role:<9}  {key.public[:8]}...")
    if not (keys or problems or as_json):
        say("no keys: nobody can connect from another machine")
    for problem in problems:
        say(problem, err=True)
    raise typer.Exit(1 if problems else 0)


@app.command()
def revoke(name: NameArgument, rig: OwnRigOption = None, overrides: SetOption = None) -> None:
    """Revoke a key.

    A running supervisor disconnects its holder at once.
    """
    revoke_key(rig_of(named_rig(rig), overrides), name)
    say(f"key of {name} revoked")
