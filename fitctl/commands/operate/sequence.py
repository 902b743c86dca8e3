"""`fitctl sequence`: run a sequence on the rig, check or rehearse it without one, steer the one that runs.

What only some of its commands need is imported within them: scipy must not delay `fitctl sequence end`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fitctl.commands.shared import completion
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import (
    JsonOption,
    RemoteOption,
    RigOption,
    SeedOption,
    SetOption,
    ShippedRigOption,
)
from fitctl.commands.shared.present import present_of_rig
from fitctl.commands.shared.printing import progress_line, say, say_lines, to_json
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address, client_of, connect, send_and_print, show_rig
from fitctl.config import ConfigError, Rig
from fitctl.messages.commands import SequenceControl
from fitctl.processes import ended_by_signals, interrupt
from fitctl.sequences.files import find_sequence, shipped_sequences

if TYPE_CHECKING:
    from collections.abc import Callable

    from fitctl.logging.records import SequenceAttempt
    from fitctl.messages.commands import SequenceStatus
    from fitctl.sequences.behaviours.behaviour import Calibration
    from fitctl.sequences.links import Link
    from fitctl.sequences.steps import Sequence
    from fitctl.simulation.simulation import Simulation

app = typer.Typer(
    help="Run, check and steer sequences of steps.",
)

SequenceArgument = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="A TOML or YAML file, or the name of a shipped sequence.",
        autocompletion=completion.sequences,
    ),
]
StepSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the rig file, or of the sequence: steps.2.duration_s=60, or "
        "steps.hold.duration_s=60 for every hold; may be repeated.",
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder to write calibrations to: fragments for the include list of a rig file.",
    ),
]


def _load(file: Path, rig: Path | None, overrides: list[str] | None) -> tuple[Rig, Sequence]:
    from fitctl.sequences.reading import load_sequence

    values, of_steps = _parted(overrides)
    settings = rig_of(rig, values)
    return settings, load_sequence(find_sequence(file), settings, of_steps)


def _addressed(file: Path, rig: Path | None, overrides: list[str] | None) -> tuple[Path, list[str]]:
    """The rig file and overrides of the instrument that the command addresses, for a sequence."""
    from fitctl.sequences.reading import read_sequence

    values, steps = _parted(overrides)
    read_sequence(find_sequence(file), steps)  # what is wrong with the sequence is reported first
    found = address("sequence", rig, values)
    return found.file, [*found.settings, *steps]


def _parted(overrides: list[str] | None) -> tuple[list[str], list[str]]:
    """Overrides of the rig file, and those of the sequence."""
    of_steps = [text for text in overrides or () if text.startswith("steps.")]
    return [text for text in overrides or () if text not in of_steps], of_steps


@app.command("list")
def list_(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE...]",
            help="Sequence files, or names of shipped ones. [default: the shipped sequences]",
            autocompletion=completion.sequences,
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print one JSON array of the sequences, with every step and key."
        ),
    ] = False,
) -> None:
    """List the shipped sequences."""
    from fitctl.sequences.reading import read_sequence

    paths = map(find_sequence, files) if files else shipped_sequences()
    listed = {path: read_sequence(path) for path in paths}
    if as_json:
        documents = [
            {"file": str(path), **sequence.model_dump(exclude_none=True)}
            for path, sequence in listed.items()
        ]
        say(to_json(documents))
        return
    width = max(len(sequence.name) for sequence in listed.values())
    for sequence in listed.values():
        say(f"{sequence.name:<{width}}  {sequence.description}")


@app.command()
def check(
    file: SequenceArgument,
    rig: ShippedRigOption = None,
    overrides: StepSetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Validate a sequence for a rig."""
    settings, sequence = _load(file, rig, overrides)
    if as_json:
        found = {"file": str(file), "steps": len(sequence.steps), "rig": settings.name}
        say(to_json(found))
        return
    say(f"{file}: well; {len(sequence.steps)} steps for rig {settings.name}")


@app.command("dry-run")
def dry_run(
    file: SequenceArgument,
    rig: ShippedRigOption = None,
    overrides: StepSetOption = None,
    seed: SeedOption = 0,
    present: Annotated[
        bool,
        typer.Option(
            "--present",
            help="Start from the stages and stars of the rig that fitctl sequence run addresses.",
        ),
    ] = False,
    remote: RemoteOption = None,
    as_json: JsonOption = False,
    out: OutOption = None,
) -> None:
    """Run a whole sequence on a virtual clock.

    Takes seconds, and prints the result of every attempt. Writes calibrations of the simulated rig only with
    --out. With --present, the simulation starts from the stages and stars of the running instrument; a star
    that is not measured now is assumed to be on its target.
    """
    from fitctl.sequences.links import SimulatedLink

    if present and remote is None:
        rig, overrides = _addressed(file, rig, overrides)
    settings, sequence = _load(file, rig, overrides)
    settings.mock_parts()
    begun = time.perf_counter()
    prepare = _placed(settings, remote) if present else lambda _: None
    link = SimulatedLink(settings, seed, prepare, advises=sequence.uses_what_is_learnt)
    status = _run(settings, sequence, link, out, as_json=as_json)
    if not as_json:
        say(f"{link.now_s():.1f} s of virtual time, in {time.perf_counter() - begun:.1f} s")
    raise typer.Exit(status)


def _placed(rig: Rig, remote: Path | None) -> Callable[[Simulation], None]:
    """What puts a simulation where the running instrument's stages and stars are."""
    from fitctl.simulation.rehearsal import place

    state = present_of_rig(rig, remote, "sequence")
    return lambda simulation: place(simulation, state)


@app.command()
def run(
    file: SequenceArgument,
    rig: RigOption = None,
    overrides: StepSetOption = None,
    remote: RemoteOption = None,
    as_json: JsonOption = False,
    out: OutOption = Path(),
) -> None:
    """Run a sequence on the instrument.

    Ctrl-C ends the present step and the sequence; the loops release their stars.
    """
    if remote is None:
        rig, overrides = _addressed(file, rig, overrides)
    settings, sequence = _load(file, rig, overrides)
    client = client_of(settings, remote)
    show_rig(settings.name, str(rig or remote))
    try:
        status = _run(settings, sequence, client, out, as_json=as_json)
    finally:
        client.close()
    raise typer.Exit(status)


@app.command()
def pause(rig: RigOption = None, overrides: SetOption = None, remote: RemoteOption = None) -> None:
    """Pause the running sequence.

    It pauses at once within the steps hold and wait, and otherwise before the next attempt at a step.
    """
    _steer("pause", rig, overrides, remote)


@app.command()
def resume(rig: RigOption = None, overrides: SetOption = None, remote: RemoteOption = None) -> None:
    """Continue a paused sequence."""
    _steer("resume", rig, overrides, remote)


@app.command()
def end(rig: RigOption = None, overrides: SetOption = None, remote: RemoteOption = None) -> None:
    """End the running sequence.

    Its loops release their stars: STANDBY. For SAFE, use `fitctl send stop`.
    """
    _steer("end", rig, overrides, remote)


@app.command(hidden=True)
def stop() -> None:
    """Refuse a name that has another meaning."""
    msg = "sequence stop: is now fitctl sequence end; for SAFE, use fitctl send stop"
    raise ConfigError(msg)


def _steer(
    action: Literal["pause", "resume", "end"],
    rig: Path | None,
    overrides: list[str] | None,
    remote: Path | None,
) -> None:
    client = connect("sequence", rig, overrides, remote)
    raise typer.Exit(send_and_print(client, SequenceControl(action=action), "sequence"))


def _run(rig: Rig, sequence: Sequence, link: Link, out: Path | None, *, as_json: bool) -> int:
    """Run, show progress, print what every attempt gave, write calibrations; returns the exit status."""
    from fitctl.commands.operate.sequence_text import as_json_text, attempts_text, where
    from fitctl.sequences.behaviours.calibration import (
        CALIBRATING,
        require_folder,
        write_calibration,
    )
    from fitctl.sequences.contact import Contact
    from fitctl.sequences.runner import Runner, run_steps
    from fitctl.sequences.view import SequenceError

    if out is not None and any(step.step in CALIBRATING for step in sequence.steps):
        require_folder(out)
    attempts: list[SequenceAttempt] = []
    measured: list[Calibration] = []
    failure = "interrupted"
    try:
        with (
            ended_by_signals(interrupt),
            progress_line(sequence.name, len(sequence.steps)) as progress,
        ):

            def show(status: SequenceStatus) -> None:
                newest = status.last_attempt
                if newest is not None and newest not in attempts[-1:]:
                    attempts.append(newest)
                done = {each.step_number for each in attempts if each.outcome == "done"}
                steps_done = len(done - {status.step_number}) + (status.state == "done")
                progress(steps_done, where(status))

            runner = Runner(Contact(link, rig, sequence.name, len(sequence.steps), show))
            measured = runner.calibrations
            run_steps(runner, sequence.steps)
            failure = ""
    except (SequenceError, ConnectionError) as error:
        failure = str(error)
    finally:  # an interrupt loses nothing of what was measured before
        if as_json:
            say(as_json_text(sequence.name, failure, attempts))
        elif attempts:
            say_lines(attempts_text(attempts))
        if out is not None:
            for calibration in measured:
                path = write_calibration(calibration, rig, out)
                say(f"written: {path} (name it in the rig file's include list)", err=as_json)
    if failure:
        say(f"sequence {sequence.name}: {failure}", err=True)
        return FAILED
    return 0
