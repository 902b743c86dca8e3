"""`fitctl commission`: from devices that answer to a star held, step by step."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from fitctl.commands.shared.exits import FAILED, INTERRUPTED
from fitctl.commands.shared.options import JsonOption, OwnRigOption, SetOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import named_rig
from fitctl.commands.shared.terminal import has_terminal
from fitctl.commissioning.outcome import Cable, State, StepError
from fitctl.commissioning.page import change_texts, changes, flat, page, verdict
from fitctl.commissioning.record import Commissioning, Entry, Files, load, load_any, writable
from fitctl.commissioning.run import Course, chosen, do, skip
from fitctl.commissioning.tasks import Task, tasks_of
from fitctl.config import ConfigError, Rig, default_rig_path, load_rig
from fitctl.config.reading import read_parts
from fitctl.config.simulated import places
from fitctl.mocks.bench import ClearFaults, FaultsNow, SetFault, ask_bench
from fitctl.processes import ENDING_SIGNALS, end_with_parent, ended_by_signals, name_held

_MARKS: dict[State, str] = {
    "passed": "passed",
    "corrected": "corrected",
    "measured": "measured",
    "failed": "FAILED",
    "skipped": "skipped",
}
_CHANGE = "{:<56} {:>12} {:>12} {:>9}"  # a figure of two commissionings


def commission(
    rig: OwnRigOption = None,
    overrides: SetOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before a step; for mocks only.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STEP",
            help="Do only this step, even if it was done. You can give this option several times.",
        ),
    ] = None,
    until: Annotated[str, typer.Option(metavar="STEP", help="Stop when this step is done.")] = "",
    skipped: Annotated[
        list[str] | None,
        typer.Option(
            "--skip", metavar="STEP=REASON", help="Leave a step out; the reason is recorded."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A short acceptance: 3 acquisitions, 20 s, one step.")
    ] = False,
    list_steps: Annotated[
        bool, typer.Option("--list", help="List the steps, what each moves, and what is done.")
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder of record and rig file. [default: the rig file's]"
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="RECORD", help="Compare with the record of another commissioning."),
    ] = None,
    on_console: Annotated[
        bool, typer.Option("--console", help="Run the steps on a console.")
    ] = False,
    console_pid: Annotated[
        int | None,
        typer.Option(hidden=True, help="The console that answers on the standard input."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Commission a rig: prove it step by step, correct its rig file, and stop at the first trouble.

    Each step prints what it will move and by how much, asks once, and stops if something unexpected happens.
    fitctl records finished steps beside the rig file, and continues there next time. No supervisor may run.
    Exit status 1 if a step fails or is not done.
    """
    if list_steps and (skipped or compare):
        msg = "commission: --list only lists the steps; leave out --skip and --compare"
        raise ConfigError(msg)
    path = named_rig(rig) or default_rig_path()
    settings = load_rig(path, overrides or ())
    where = _folder(path, folder, reads_only=list_steps)
    if on_console:
        if only or until or skipped or compare or list_steps or as_json:
            msg = "commission: --console has each step to choose; leave out --only, --until, --skip and such"
            raise ConfigError(msg)
        from fitctl.commands.operate.console import commissioning_console

        short = ["--quick"] if quick else []
        commissioning_console(path, overrides or (), ["--folder", str(where), *short])
        return
    real = [place.device for place in places(settings).values() if not place.simulated]
    if not list_steps:
        _require_permission(real, yes=yes, by_console=console_pid is not None)
    end_with_parent(console_pid)
    files = Files(path, where)
    with ExitStack() as locked:
        if not list_steps:
            _lock(locked, files.record)
            files.require_own()
        course = Course(
            path,
            tuple(overrides or ()),
            files,
            load(files.record, settings.name),
            # An operator who answers questions must see what moves.
            _reporter(silent=as_json and yes),
            quick,
            _by_hand if real or not (yes or console_pid) else partial(_by_bench, settings),
        )
        earlier = None if compare is None else load_any(compare)
        tasks = tasks_of(settings)
        wanted = _wanted(tasks, only or [], until)
        if list_steps:
            _list(course, tasks, as_json=as_json)
            return
        left_out = [task for text in skipped or [] for task in _skip(course, tasks, text)]
        wanted = [task for task in wanted if task not in left_out]
        try:
            with ended_by_signals(_interrupt_once):
                _do_all(course, wanted, again=bool(only), yes=yes)
        except KeyboardInterrupt:
            say(
                "commission: interrupted; nothing is recorded of the step that was running",
                err=True,
            )
            raise typer.Exit(INTERRUPTED) from None
        _conclude(course, tasks, earlier, as_json=as_json)
        if not all(course.record.done(task.name) for task in wanted):
            raise typer.Exit(FAILED)


def _lock(locked: ExitStack, record: Path) -> None:
    """Keep a second commissioning from the same record: each would overwrite what the other wrote."""
    try:
        locked.enter_context(name_held(f"fitctl-commissioning:{record.resolve()}"))
    except BlockingIOError as error:
        msg = (
            f"commission: {record}: another commissioning ({error.strerror}) works on this record; end it "
            "first, or choose another place with --folder"
        )
        raise ConfigError(msg) from None


def _wanted(tasks: list[Task], only: list[str], until: str) -> list[Task]:
    """The tasks that --only and --until leave."""
    wanted = chosen(tasks, _known(tasks, only))
    if not until:
        return wanted
    last = tasks.index(chosen(tasks, _known(tasks, [until]))[-1])
    wanted = [task for task in wanted if tasks.index(task) <= last]
    if not wanted:
        msg = f"commission: --only {only[0]} comes after --until {until}; leave one of them out"
        raise ConfigError(msg)
    return wanted


def _interrupt_once() -> None:
    """End the running step, whose motors then stand; a second signal must not end that."""
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _by_hand(cable: Cable, on: bool) -> None:
    _ask(
        f"{'Reconnect' if on else 'Disconnect'} {cable.name}, then press Enter",
        default="",
        show_default=False,
    )


def _ask(question: str, **options: Any) -> str:
    """An answer of a person; what a console answers is printed, as a terminal shows what is typed."""
    answer: str = typer.prompt(question, **options)
    if not sys.stdin.isatty():
        say(answer)
    return answer.strip()


def _by_bench(rig: Rig, cable: Cable, on: bool) -> None:
    """Mocks have no cables: their bench cuts the device off."""
    _, mocks = rig.mock_parts()
    question = (
        ClearFaults(device=cable.mock, kind="disconnect")
        if on
        else SetFault(device=cable.mock, kind="disconnect")
    )
    try:
        now = ask_bench(mocks.bench_port, question, FaultsNow)
    except ConnectionError as error:
        raise StepError(str(error)) from None
    if now.error:
        raise StepError(now.error)


def _require_permission(real: list[str], *, yes: bool, by_console: bool) -> None:
    if yes and real:
        msg = f"commission: --yes is for mocks; these devices are real: {', '.join(real)}"
        raise ConfigError(msg)
    if not (yes or by_console or has_terminal()):
        msg = "commission: asks before each step, which needs a terminal; on mocks, give --yes"
        raise ConfigError(msg)


def _folder(path: Path, folder: Path | None, *, reads_only: bool) -> Path:
    wanted = folder or (Path.cwd() if path == default_rig_path() else path.parent)
    if not os.path.isdir(wanted):  # also where it cannot be examined
        msg = f"commission: {wanted}: no such folder; make it, or choose another with --folder"
        raise ConfigError(msg)
    if not (reads_only or writable(wanted)):
        msg = f"commission: {wanted}: nothing can be written there; choose another with --folder"
        raise ConfigError(msg)
    for name in (path.resolve(), wanted.resolve()):
        try:
            str(name).encode()
        except UnicodeEncodeError:
            msg = (
                f"commission: {name}: its name is not UTF-8, as names in a rig file are; rename it"
            )
            raise ConfigError(msg) from None
    return wanted


def _reporter(*, silent: bool) -> Callable[[str], None]:
    return (lambda _line: None) if silent else (lambda line: say(f"    {line}"))


def _known(tasks: list[Task], names: list[str]) -> list[str]:
    for name in names:
        if not chosen(tasks, [name]):
            there_are = ", ".join(task.name for task in tasks)
            msg = f"commission: unknown step {name!r}. Available: {there_are}"
            raise ConfigError(msg)
    return names


def _skip(course: Course, tasks: list[Task], text: str) -> list[Task]:
    name, _, reason = text.partition("=")
    if not reason.strip():
        msg = f"commission: --skip {text}: expected STEP=REASON, such as star='cloudy'"
        raise ConfigError(msg)
    left_out = chosen(tasks, _known(tasks, [name]))
    for task in left_out:
        skip(course, task, reason.strip())
    return left_out


def _do_all(course: Course, wanted: list[Task], *, again: bool, yes: bool) -> None:
    """Do what is left to do, up to the first trouble."""
    for task in wanted:
        if course.record.done(task.name) and not again:
            continue
        if missing := course.missing(task):
            course.report(f"{task.name}: not before {', '.join(missing)}")
            return
        course.report(f"{task.name}: {task.step.title}. About {task.step.takes_s:g} s.")
        course.report(f"Moves: {task.step.moves(course.site(task, course.rig(task.name)))}.")
        if not yes:
            answer = _ask("Go? (yes, no, skip)", default="no").lower()
            if answer in {"s", "skip"}:
                skip(course, task, _ask("Reason for the record"))
                continue
            if answer not in {"y", "yes"}:
                course.report("stopped; the next run continues here")
                return
        entry = do(course, task)
        for line in _entry_lines(task.name, entry):
            course.report(line)
        if entry.state == "failed":
            return


def _entry_lines(name: str, entry: Entry) -> list[str]:
    return [f"{_MARKS[entry.state]}: {name}, {entry.took_s:.1f} s", *_seen_lines(entry)]


def _seen_lines(entry: Entry) -> list[str]:
    found = [f"rig file: {key} = {value}" for key, value in flat(entry.found).items()]
    return [*entry.lines, *found, *([entry.trouble] if entry.trouble else [])]


def _list(course: Course, tasks: list[Task], *, as_json: bool) -> None:
    rig = course.rig()
    conclusion = verdict(course.record, [task.name for task in tasks])
    if as_json:
        listed = [_listed(course, task, rig) for task in tasks]
        say(to_json({"rig": course.record.rig, "verdict": conclusion, "tasks": listed}))
        return
    for task in tasks:
        entry = course.record.tasks.get(task.name)
        state = "to do" if entry is None else f"{_MARKS[entry.state]} {entry.at}"
        say(f"{task.name:<24} {state:<32} {task.step.title}")
        say(f"{'':<24} moves: {task.step.moves(course.site(task, rig))}")
        for line in () if entry is None else _seen_lines(entry):
            say(f"{'':<24} {line}")
    say(f"{course.record.rig}: {conclusion}")


def _listed(course: Course, task: Task, rig: Rig) -> dict[str, Any]:
    """A task and what came of it, for programs."""
    entry = course.record.tasks.get(task.name)
    return {
        "name": task.name,
        "title": task.step.title,
        "moves": task.step.moves(course.site(task, rig)),
        "takes_s": task.step.takes_s,
        "missing": course.missing(task),
        "done": course.record.done(task.name),
        "entry": entry,
    }


def _conclude(
    course: Course, tasks: list[Task], earlier: Commissioning | None, *, as_json: bool
) -> None:
    record, files = course.record, course.files
    titles = {task.name: task.step.title for task in tasks}
    said = flat(read_parts(course.rig_path, course.overrides).document)
    files.write_page(page(record, titles, earlier, said))
    if as_json:
        document: dict[str, Any] = {
            "rig": record.rig,
            "verdict": verdict(record, titles),
            "tasks": record.tasks,
            "found": record.found(order=list(titles)),
            "files": {
                "record": str(files.record),
                "rig": str(files.rig),
                "page": str(files.page),
            },
        }
        if earlier is not None:
            document["compared"] = [
                {"figure": one.figure, "now": one.now, "earlier": one.then}
                for one in changes(record, earlier)
            ]
        say(to_json(document))
        return
    if earlier is not None:
        say(_CHANGE.format("figure", "now", "earlier", "change"))
        for change in changes(record, earlier):
            say(_CHANGE.format(change.figure, *change_texts(change)).rstrip())
    say(f"{record.rig}: {verdict(record, titles)}")
    say(f"record: {files.record}")
    say(f"page: {files.page}")
    say(f"rig file with what was found: {files.rig}")
