"""Do the tasks of a commissioning one after the other, and write down what comes of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from fitctl.commissioning.outcome import BEFORE, Cable, Outcome, Site, StepError, nobody_there
from fitctl.commissioning.page import flat
from fitctl.commissioning.record import Commissioning, Entry, Files, save
from fitctl.commissioning.tasks import Task, tasks_of
from fitctl.config import ConfigError, Rig, load_rig
from fitctl.config.origins import Layer, mark_layer
from fitctl.config.reading import lay_over, read_parts, rig_from_parts
from fitctl.daemon.locks import only_master
from fitctl.drivers.interface import DeviceError

_UPPERMOST = 1 << 16  # above all layers of the rig file, and above --set
_TRIES = 3  # what a correction brings to light may need another


class Course(NamedTuple):
    """A commissioning under way.

    Attributes
    ----------
    rig_path : Path
    overrides : tuple of str
    files : Files
    record : Commissioning
    report : callable
        Prints a line.
    quick : bool
        A short acceptance.
    cable : callable
        As :attr:`fitctl.commissioning.outcome.Site.cable`.
    """

    rig_path: Path
    overrides: tuple[str, ...]
    files: Files
    record: Commissioning
    report: Callable[[str], None]
    quick: bool = False
    cable: Callable[[Cable, bool], None] = nobody_there

    @property
    def order(self) -> list[str]:
        """The names of all tasks."""
        return [task.name for task in tasks_of(load_rig(self.rig_path, self.overrides))]

    def rig(self, before: str = "") -> Rig:
        """The rig file with what was found, or with what was found before a task."""
        try:
            return _rig_with(self, self.record.found(before, self.order))
        except ConfigError as error:  # the rig file alone has been read before
            msg = f"{error}; repeat the step that found it with --only, or correct the rig file"
            raise ConfigError(msg) from None

    def missing(self, task: Task) -> list[str]:
        """Tasks that must be done before this one, and are not."""
        return [name for name in task.needs() if not self.record.done(name)]

    def site(self, task: Task, rig: Rig, found: dict[str, Any] | None = None) -> Site:
        """What a task works on; `found` is what the commissioned rig file has, and counts above ``--set``."""
        return Site(
            rig,
            task.loop,
            self.report,
            self.files.rig,
            self.overrides + (_settings(found or {}) if self.overrides else ()),
            self.record.figures(),
            quick=self.quick,
            cable=self.cable,
        )


def do(course: Course, task: Task) -> Entry:
    """Do a task; where it corrects the rig, again with the correction, until nothing is left to correct.

    Meanwhile the commissioned rig file has only what was found before the task. It is whole again afterwards,
    also after an interruption.
    """
    with _whole_again(course):
        return _done(course, task)


@contextmanager
def _whole_again(course: Course) -> Iterator[None]:
    try:
        yield
    finally:
        course.files.write_rig(course.record.found(order=course.order))


def _done(course: Course, task: Task) -> Entry:
    began_s = time.monotonic()
    found: dict[str, object] = {}
    lines: list[str] = []
    first: dict[str, float] = {}
    before = course.record.found(task.name, course.order)
    rig = _written(course, before)
    for attempt in range(_TRIES):
        outcome = _attempt(course.site(task, rig, before), task)
        lines += outcome.lines
        if outcome.trouble or not outcome.found:
            break
        lay_over(found, outcome.found)
        first = first or {f"{name}{BEFORE}": value for name, value in outcome.figures.items()}
        outcome = replace(outcome, found=found)
        try:
            lay_over(before, found)
            rig = _written(course, before)
        except ConfigError as error:
            what = (
                f"with what was found, the rig file contradicts itself: {error}; correct it by hand"
            )
            outcome = Outcome(outcome.lines, outcome.figures, {}, what)
            break
        if outcome.estimated:
            break
        if attempt + 1 == _TRIES:
            what = "the corrected values are still not as expected"
            outcome = Outcome(outcome.lines, outcome.figures, found, what)
    figures = outcome.figures if outcome.estimated else outcome.figures | first
    earlier = course.record.tasks.get(task.name)
    if outcome.trouble:
        # Nothing has confirmed what was found now, and nothing speaks against what was found before.
        found = {} if earlier is None else earlier.found
    whole = replace(outcome, lines=lines, figures=figures, found=found)
    if earlier is not None and earlier.found != found:
        _forget_dependents(course, task)
    entry = course.record.enter(task.name, whole, time.monotonic() - began_s)
    save(course.files.record, course.record)
    return entry


def _forget_dependents(course: Course, task: Task) -> None:
    """What was measured with other values of the rig file is to be measured again."""
    stale = {task.name}
    for later in tasks_of(course.rig()):
        if stale & set(later.needs()):
            stale.add(later.name)
            course.record.tasks.pop(later.name, None)


def skip(course: Course, task: Task, reason: str) -> Entry:
    """Leave a task out, for a reason that stays in the record, with what it found before."""
    earlier = course.record.tasks.get(task.name)
    before = Outcome() if earlier is None else Outcome(figures=earlier.figures, found=earlier.found)
    entry = course.record.enter(task.name, replace(before, trouble=reason), 0.0, "skipped")
    save(course.files.record, course.record)
    return entry


def _attempt(site: Site, task: Task) -> Outcome:
    try:
        with nullcontext() if task.step.supervised else only_master(site.rig):
            return task.step.run(site)
    except StepError as error:
        return Outcome(figures=error.figures, trouble=str(error))
    except DeviceError as error:
        return Outcome(trouble=str(error))


def _written(course: Course, found: dict[str, Any]) -> Rig:
    """The rig with what was found, of which the commissioned rig file is written.

    Raises
    ------
    ConfigError
        If it contradicts itself; the file stays as it was.
    """
    rig = _rig_with(course, found)
    course.files.write_rig(found)
    return rig


def _rig_with(course: Course, found: dict[str, Any]) -> Rig:
    """The rig file with what was found laid over it; errors name the record for what was found."""
    laid = read_parts(course.rig_path, course.overrides)
    layer = Layer(str(course.files.record), "found", _UPPERMOST)
    mark_layer(laid.marks, laid.document, found, layer)
    lay_over(laid.document, found)
    return rig_from_parts(laid, str(course.rig_path))


def _settings(found: dict[str, Any]) -> tuple[str, ...]:
    """A fragment of a rig file as values for ``--set``."""
    return tuple(f"{key}={_inline(value)}" for key, value in flat(found).items())


def _inline(value: object) -> str:
    """A value in TOML on one line."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {_inline(part)}' for key, part in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return tomlkit.item(value).as_string()


def chosen(tasks: Sequence[Task], only: Sequence[str]) -> list[Task]:
    """The tasks that names ask for: of a task, or of a step, which is of every loop that has it."""
    return [
        task for task in tasks if not only or {task.name, task.name.rpartition(".")[2]} & set(only)
    ]
