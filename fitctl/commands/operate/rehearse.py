"""`fitctl rehearse`: what a command would do, without giving it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fitctl.commands.shared import completion
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import JsonOption, RemoteOption, RigOption, SetOption
from fitctl.commands.shared.present import present_of_rig
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address, show_rig
from fitctl.config import ConfigError
from fitctl.messages.command_table import command_of
from fitctl.processes import ended_by_signals, interrupt

if TYPE_CHECKING:
    from fitctl.simulation.rehearsal import End, Rehearsal

# -1 is a value, not an option.
SETTINGS = {"context_settings": {"ignore_unknown_options": True}}


def rehearse(
    command: Annotated[
        str, typer.Argument(help="A command of fitctl send: target, jog, recover ...")
    ],
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
    limit_s: Annotated[
        float,
        typer.Option(
            "--timeout", metavar="SECONDS", min=1.0, help="Longest wait for the rehearsal."
        ),
    ] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Show what a command would do, without sending it.

    Reads the present modes, stages and targets of the running instrument, and starts a simulation of the rig
    from them. Sends the command to the simulation, and prints where the stages end and which interlocks trip.
    The rig file needs a plant section. A star that is not measured now is assumed to be on its target.
    """
    from fitctl.simulation.rehearsal import RehearsalError, require_rehearsable
    from fitctl.simulation.rehearsal import rehearse as rehearsed

    wanted = command_of(command, values or [], loop, "rehearse")
    require_rehearsable(wanted)
    if remote is None:
        found = address("rehearse", rig, overrides)
        rig, overrides = found.file, found.settings
    elif rig is None:
        msg = "rehearse: with --remote, name the rig file of that instrument with --rig; it is simulated here"
        raise ConfigError(msg)
    settings = rig_of(rig, overrides)
    settings.mock_parts()
    show_rig(settings.name, str(rig or remote))
    state = present_of_rig(settings, remote, "rehearse")
    try:
        with ended_by_signals(interrupt):
            result = rehearsed(settings, state, wanted, limit_s)
    except RehearsalError as error:
        say(f"rehearse: {error}", err=True)
        raise typer.Exit(FAILED) from None
    if as_json:
        say(to_json(result))
    else:
        _print(" ".join([command, *(values or [])]), result)
    raise typer.Exit(0 if result.accepted else FAILED)


def _print(words: str, result: Rehearsal) -> None:
    say(f"{words}, from the present state; nothing was sent")
    if not result.accepted:
        say(f"✗ would be refused: {result.refused}")
        return
    say(f"after {result.duration_s:.0f} s:")
    for end in result.ends:
        for line in _end_lines(end):
            say(line)
    for trip in result.trips:
        say(
            f"✗ {trip.loop}: interlock {trip.name} would trip after {trip.after_s:.1f} s ({trip.action})"
        )
        say(f"  {trip.reason}")
    if not result.trips:
        say("✓ no interlock would trip")
    for event in result.events:
        say(f"▲ {event}")
    for name in result.in_force:
        say(f"▲ tripped on the instrument now, and not in the rehearsal: {name}")
    for difference in result.unlike:
        say(f"▲ {difference}, so the result may differ")


def _end_lines(end: End) -> list[str]:
    was, becomes = end.mode
    mode = was if was == becomes else f"{was} → {becomes}"
    lines = [f"{end.loop}: {mode}"]
    (az0, el0), (az1, el1) = end.siderostat_sky_arcsec
    lines.append(f"  siderostat  {az0:+.1f} {el0:+.1f} → {az1:+.1f} {el1:+.1f} arcsec on the sky")
    if end.mirror_urad is not None and end.mirror_range_fraction is not None:
        (az0, el0), (az1, el1) = end.mirror_urad
        used = " → ".join(f"{100 * part:.0f} %" for part in end.mirror_range_fraction)
        lines.append(
            f"  mirror      {az0:+.1f} {el0:+.1f} → {az1:+.1f} {el1:+.1f} µrad, {used} of its range"
        )
    return lines
