"""`fitctl sequence`: run a sequence on the rig, check or rehearse it without one, steer the one that runs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import typer

from fitctl.commands.options import JsonOption, RigOption, SeedOption, SetOption
from fitctl.config import Rig, default_rig_path, load_rig

if TYPE_CHECKING:
    from fitctl.logging.records import SequenceAttempt
    from fitctl.sequences.links import Link
    from fitctl.sequences.steps import Sequence
    from fitctl.supervisor.messages import SequenceStatus

FAILED = 1

app = typer.Typer(
    help="Run, check and steer sequences of acquisition and experiment steps.",
    no_args_is_help=True,
)

SequenceArgument = Annotated[
    Path, typer.Argument(metavar="FILE", help="A TOML file, or the name of a shipped sequence.")
]


def _load(file: Path, rig: Path | None, overrides: list[str] | None) -> tuple[Rig, Sequence]:
    from fitctl.sequences.reading import find_sequence, load_sequence

    settings = load_rig(rig or default_rig_path(), overrides or ())
    return settings, load_sequence(find_sequence(file), settings)


@app.command("list")
def list_(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILE...]", help="These, not the shipped ones.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Every step with every key, as JSON.")
    ] = False,
) -> None:
    """Print the shipped sequences."""
    from fitctl.sequences.reading import read_sequence, shipped_folder

    paths = files or sorted(shipped_folder().glob("*.toml"))
    listed = {path: read_sequence(path) for path in paths}
    if as_json:
        documents = [
            {"file": str(path), **sequence.model_dump(exclude_none=True)}
            for path, sequence in listed.items()
        ]
        typer.echo(msgspec.json.encode(documents).decode())
        return
    width = max(len(sequence.name) for sequence in listed.values())
    for sequence in listed.values():
        typer.echo(f"{sequence.name:<{width}}  {sequence.description}")


@app.command()
def check(file: SequenceArgument, rig: RigOption = None, overrides: SetOption = None) -> None:
    """Say what is wrong with a sequence for a rig, without the instrument."""
    settings, sequence = _load(file, rig, overrides)
    typer.echo(f"{file}: well; {len(sequence.steps)} steps for rig {settings.name}")


@app.command("dry-run")
def dry_run(
    file: SequenceArgument,
    rig: RigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Run a whole sequence on the virtual clock, in seconds, and print what every attempt gave."""
    from fitctl.sequences.links import SimulatedLink

    settings, sequence = _load(file, rig, overrides)
    settings.mock_parts()
    begun = time.perf_counter()
    link = SimulatedLink(settings, seed)
    status = _run(settings, sequence, link, as_json=as_json)
    if not as_json:
        typer.echo(f"{link.now_s():.1f} s of virtual time, in {time.perf_counter() - begun:.1f} s")
    raise typer.Exit(status)


@app.command()
def run(
    file: SequenceArgument,
    rig: RigOption = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run a sequence on the rig's running supervisor. Ctrl-C ends its step, holds the stages, and ends."""
    from fitctl.supervisor.client import Client
    from fitctl.supervisor.endpoints import service_folder

    settings, sequence = _load(file, rig, overrides)
    client = Client(service_folder(settings))
    try:
        status = _run(settings, sequence, client, as_json=as_json)
    finally:
        client.close()
    raise typer.Exit(status)


@app.command()
def pause(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Pause the sequence that is running: after its step, or at once within hold and wait."""
    _steer("pause", rig, overrides)


@app.command()
def resume(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Let a paused sequence go on."""
    _steer("resume", rig, overrides)


@app.command()
def stop(rig: RigOption = None, overrides: SetOption = None) -> None:
    """End the sequence that is running; its stages are held. For SAFE, see `fitctl send stop`."""
    _steer("stop", rig, overrides)


def _steer(
    action: Literal["pause", "resume", "stop"], rig: Path | None, overrides: list[str] | None
) -> None:
    from fitctl.supervisor.client import Client
    from fitctl.supervisor.endpoints import service_folder
    from fitctl.supervisor.messages import SequenceControl

    client = Client(service_folder(load_rig(rig or default_rig_path(), overrides or ())))
    try:
        reply = client.send(SequenceControl(action=action))
    except ConnectionError as error:
        typer.echo(f"sequence: {error}", err=True)
        raise typer.Exit(FAILED) from None
    finally:
        client.close()
    typer.echo(reply.text or "accepted", err=not reply.accepted)
    raise typer.Exit(0 if reply.accepted else FAILED)


def _run(rig: Rig, sequence: Sequence, link: Link, *, as_json: bool) -> int:
    """Run, show progress, then print what every attempt gave; returns the exit status."""
    from fitctl.commands.instrument import interrupt
    from fitctl.commands.progress import progress_line
    from fitctl.processes import ended_by_signals
    from fitctl.sequences.runner import run_sequence
    from fitctl.sequences.view import SequenceError

    attempts: list[SequenceAttempt] = []
    failure = "interrupted"
    with ended_by_signals(interrupt), progress_line() as progress:
        task = progress.add_task(sequence.name, total=len(sequence.steps))

        def show(status: SequenceStatus) -> None:
            newest = status.last_attempt
            if newest is not None and newest not in attempts[-1:]:
                attempts.append(newest)
            done = sum(attempt.outcome == "done" for attempt in attempts)
            progress.update(task, completed=done, description=_where(status))

        try:
            run_sequence(link, rig, sequence, show)
            failure = ""
        except (SequenceError, ConnectionError) as error:
            failure = str(error)
        finally:
            progress.stop()
            if as_json:
                typer.echo(_json(sequence.name, failure, attempts))
            elif attempts:
                typer.echo(_table(attempts))
    if failure:
        typer.echo(f"sequence {sequence.name}: {failure}", err=True)
        return FAILED
    return 0


def _where(status: SequenceStatus) -> str:
    again = f", attempt {status.attempt}" if status.attempt > 1 else ""
    state = "" if status.state == "running" else f" {status.state}"
    return f"{status.name}{state} {status.step_number}/{status.steps} {status.step}{again}"


def _table(attempts: list[SequenceAttempt]) -> str:
    """One line for each attempt; its times are the instrument's."""
    head = f"{'step':>4}  {'':<11}  {'try':>3}  {'outcome':<9}  {'s':>7}"
    lines = [
        f"{each.step_number:>4}  {each.step:<11}  {each.attempt:>3}  {each.outcome:<9}  "
        f"{each.ended_s - each.began_s:>7.1f}  {each.message}".rstrip()
        for each in attempts
    ]
    return "\n".join([head, *lines])


def _json(name: str, failure: str, attempts: list[SequenceAttempt]) -> str:
    told = [
        msgspec.to_builtins(each) | {"figures": msgspec.Raw(each.figures_json.encode())}
        for each in attempts
    ]
    for each in told:
        del each["figures_json"]
    document = {"sequence": name, "failure": failure, "attempts": told}
    return msgspec.json.encode(document).decode()
