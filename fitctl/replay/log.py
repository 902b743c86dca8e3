"""A run's log taken apart into what the supervisor had at each step, for replay."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from fitctl.config import Rig
from fitctl.logging.copying import merge
from fitctl.logging.errors import LogError
from fitctl.logging.reading import (
    LogInfo,
    clock_of,
    log_info,
    logs_of_one_run_each,
    read_records,
)
from fitctl.logging.records import (
    CAMERA,
    MOST,
    AnyRecord,
    BeamPlace,
    CommandRecord,
    ControllerChange,
    DeviceFailure,
    DeviceHealth,
    DevicesOpened,
    ExperimentStart,
    FrameRecord,
    InjectionRecord,
    LoopTiming,
    MetrologyTick,
    ModeChange,
    OutputsFound,
    Overlap,
    PiezoReading,
    QuantityReading,
    RecorderStatus,
    StarPlace,
    Tick,
)
from fitctl.logging.schemas import TOPICS
from fitctl.messages.modes import Mode

_AT_THE_START_S = 10.0  # the first record of a run comes within this
# What a step begins with; then come its ticks, each after what led to it; then the frame, and the rest.
_BEGIN = {CommandRecord, ControllerChange, DevicesOpened, PiezoReading, QuantityReading}
_BEFORE_TICK = {
    BeamPlace,
    ControllerChange,
    DeviceFailure,
    ExperimentStart,
    InjectionRecord,
    ModeChange,
    OutputsFound,
    StarPlace,
}
_MOST_PERIODS = 1e6  # of a servo between two reports, which come every second; each takes memory
_AT_THE_END = {DeviceHealth, LoopTiming, Overlap, RecorderStatus}
_TICKS = {Tick, MetrologyTick}
KINDS: set[Any] = _BEGIN | _BEFORE_TICK | _AT_THE_END | _TICKS | {FrameRecord}
_MOTORS = ("siderostat_az_rad", "siderostat_el_rad")
_STACKS = ("stack1_v", "stack2_v", "stack3_v")
_MAY_BE_INFINITE = {"noise_az_arcsec", "noise_el_arcsec"}  # without light
# By kind and field, what a number is less than.
_MOST = {
    kind: {
        name: MOST
        for name, field_type in get_type_hints(kind).items()
        if field_type is float and name not in _MAY_BE_INFINITE
    }
    for kind in KINDS
}
_MOST[LoopTiming]["servo_periods"] = _MOST_PERIODS
# The newest field that a replay needs of each kind of tick, and what a log without it lacks.
_NEEDED = {
    Tick: ("fsm_written_s", "have neither commands nor when voltages took effect"),
    MetrologyTick: ("requested_s", "have neither when samples were requested nor where links were"),
}


class Logged(NamedTuple):
    """One record: which kind of :mod:`fitctl.logging.records`, and its protobuf message."""

    kind: type[AnyRecord]
    message: Any


@dataclass
class LoggedStep:
    """What one step of the supervisor had and made, by its log.

    Attributes
    ----------
    begin : list of Logged
        Commands, answers of devices, quantities: what came before the ticks.
    before_tick : dict of str to list of Logged
        By loop: what its tick, or a command, made known in this step, in order.
    ticks : dict of str to Message
        By loop; of a loop that is OFF only those with a frame.
    overlap : Message or None
        Of the two stars on the frame.
    frame : Message or None
        On which the ticks acted.
    older : list of Message
        Frames that came with it, and on which no tick acted.
    records_lost : int
        On the way to the log until then, where the recorder said so in this step.
    timing : dict of str to Message
        By loop, once a second.
    reported_s : float
        When that was, by the camera's health; NaN in most steps.
    """

    begin: list[Logged] = field(default_factory=list)
    before_tick: dict[str, list[Logged]] = field(default_factory=lambda: defaultdict(list))
    ticks: dict[str, Any] = field(default_factory=dict)
    overlap: Any = None
    frame: Any = None
    older: list[Any] = field(default_factory=list)
    records_lost: int = 0
    timing: dict[str, Any] = field(default_factory=dict)
    reported_s: float = math.nan

    def add_frame(self, message: Any, number: int) -> None:
        """One frame of the step; one that is damaged counts for none."""
        whole = len(message.data) == 2 * message.width * message.height  # 16 bit a pixel
        if number in {tick.number % 2**32 for tick in self.ticks.values()}:
            self.frame = message if whole else None
        elif whole:
            self.older.append(message)

    def add_report(self, kind: type[AnyRecord], message: Any) -> None:
        """A loop's timing, the records that the recorder lost, or the time of the camera's last report."""
        if kind is LoopTiming:
            self.timing[message.loop] = message
        elif kind is RecorderStatus:
            self.records_lost = message.lost
        elif kind is DeviceHealth and message.device == CAMERA:
            self.reported_s = message.time_s

    @property
    def is_torn(self) -> bool:
        """Whether ticks have lost their frame: a log that was torn may end between the two."""
        return self.frame is None and any(tick.number >= 0 for tick in self.ticks.values())

    def of(self, kind: type[AnyRecord], loop: str | None = None) -> list[Any]:
        """Messages of one kind, of the beginning, or of what came before a loop's tick."""
        records = self.begin if loop is None else self.before_tick[loop]
        return [record.message for record in records if record.kind is kind]


@contextmanager
def whole_run(paths: Sequence[Path]) -> Iterator[LogInfo]:
    """One log of a run out of the files that it was rotated into, or cut in by a crash.

    Several files are copied into one, in the folder for temporary files.

    Raises
    ------
    LogError
        If a file cannot be read or is damaged, they are of several runs, what they hold does not begin
        where the run did, or the temporary folder has no room for the copy.
    """
    runs = {log.path: log.metadata.get("clock", {}) for log in logs_of_one_run_each(paths)}
    first = runs[paths[0]]
    for path, run in runs.items():
        if run.get("run_start_monotonic_s") != first.get("run_start_monotonic_s"):
            msg = f"{path}: is of another run than {paths[0]}; replay one run at a time"
            raise LogError(msg)
    if len(paths) == 1:
        yield log_info(paths[0])
        return
    with tempfile.TemporaryDirectory(prefix="fitctl-replay-") as folder:
        needed, free = sum(path.stat().st_size for path in paths), shutil.disk_usage(folder).free
        if free < needed:
            msg = (
                f"{Path(folder).parent}: has {free / 1e6:.0f} MB free, expected {needed / 1e6:.0f} MB for "
                f"a copy of the run's {len(paths)} files as one; make room, or set TMPDIR to another folder"
            )
            raise LogError(msg)
        together = Path(folder) / paths[0].name
        merge(paths, together)
        try:
            yield log_info(together)
        except LogError as error:  # of files that the user knows
            raise LogError(str(error).replace(str(together), ", ".join(map(str, paths)))) from None


def read_steps(info: LogInfo, rig: Rig) -> Iterator[LoggedStep]:
    """Step by step what is in a log of a rig's loops.

    Raises
    ------
    LogError
        If it cannot be replayed: it begins in the middle of a run, has no ticks or no frames, or was recorded
        before ticks told what a replay needs.
    """
    step, before_tick = LoggedStep(), defaultdict[str, list[Logged]](list)
    powered: dict[str, bool] = {}
    for record, sequence in _records(info, rig):
        kind, message = record
        loop = getattr(message, "loop", "")
        if _is_over(step, record, any(powered.values())):
            if not step.ticks:
                step.before_tick, before_tick = before_tick, defaultdict(list)
            yield step
            step = LoggedStep()
        if kind in _BEGIN:
            step.begin.append(record)
        if kind is ModeChange and message.target_number == Mode.OFF:
            powered[loop] = False
        if kind in _BEFORE_TICK:
            before_tick[loop].append(record)
        elif kind in _TICKS:
            powered[loop] = message.mode_number != Mode.OFF
            step.before_tick[loop] = before_tick.pop(loop, [])
            step.ticks[loop] = message
        elif kind is Overlap:
            step.overlap = message
        elif kind is FrameRecord:
            step.add_frame(message, sequence)
        else:
            step.add_report(kind, message)
    if not step.is_torn:
        yield step


def _records(info: LogInfo, rig: Rig) -> Iterator[tuple[Logged, int]]:
    """The records of a log that a replay needs, and their sequence numbers; LogError if they do not suffice."""
    kinds = {TOPICS[kind].format(loop=loop): kind for kind in KINDS for loop in rig.loops}
    tick_topics = [
        TOPICS[MetrologyTick if loop in rig.metrology_loops else Tick].format(loop=loop)
        for loop in rig.loops
    ]
    for topic in (TOPICS[FrameRecord], *tick_topics):
        if topic not in info.counts:
            there = ", ".join(sorted(info.counts)) or "none"
            msg = f"{info.path}: has no {topic}, so there is nothing to replay; topics: {there}"
            raise LogError(msg)
    loops = {
        TOPICS[kind].format(loop=loop): loop
        for kind in KINDS
        if "{loop}" in TOPICS[kind]
        for loop in rig.loops
    }
    begun: set[str] = set()
    is_first = True
    for entry in read_records(info.path, list(kinds)):
        kind = kinds[entry.topic]
        message: Any = entry.message
        of_loop = getattr(message, "loop", None)
        if loops.get(entry.topic, of_loop) != of_loop:
            msg = (
                f"{info.path}: {entry.topic} is not as fitctl records it: a record is of loop {of_loop!r}; "
                f"expected {loops[entry.topic]!r}; name a log that fitctl recorded"
            )
            raise LogError(msg)
        _insist_on_numbers(info, entry.topic, kind, message, rig)
        if is_first:
            _insist_on_start(info, entry.publish_time_ns)
            is_first = False
        if kind is DevicesOpened or (kind is ModeChange and message.source == Mode.OFF.name):
            begun.add(message.loop)
        elif kind in _TICKS:
            _insist_on_field(info, message, *_NEEDED[kind])
            if message.mode_number != Mode.OFF and message.loop not in begun:
                raise _midst(info, f"loop {message.loop} is in {message.mode} at its first tick")
        yield Logged(kind, message), entry.sequence


def _is_over(step: LoggedStep, record: Logged, powered: bool) -> bool:
    """Whether a record is of the next step."""
    if not step.ticks:
        # Without a powered loop no tick is logged: what comes between commands is steps all the same.
        again = record.kind is CommandRecord and record.message.command == "Standby"
        return again and not powered and bool(step.of(CommandRecord))
    if record.kind in _TICKS:
        return record.message.loop in step.ticks or step.frame is not None
    return record.kind in _BEGIN


def _insist_on_numbers(info: LogInfo, topic: str, kind: Any, message: Any, rig: Rig) -> None:
    """Refuse numbers that no instrument has, and NaN where fitctl records a number."""
    for name, most in _MOST[kind].items():
        value = getattr(message, name, 0.0)
        if abs(value) >= most or (math.isnan(value) and _must_be(kind, message, name, rig)):
            msg = (
                f"{info.path}: {topic} is not as fitctl records it: {name} is {value:g}; name a log that "
                "fitctl recorded"
            )
            raise LogError(msg)


def _must_be(kind: Any, message: Any, name: str, rig: Rig) -> bool:
    """Whether fitctl records a number here whatever happens; NaN stands for what there was not."""
    if kind is DevicesOpened:
        return name in _STACKS and not message.error and message.loop in rig.stellar_loops
    if kind in _TICKS and name == "mid_exposure_s":
        return bool(message.number >= 0)
    if kind in _TICKS and name in _MOTORS:
        return bool(message.mode_number != Mode.OFF)
    return name == "time_s" or kind in {StarPlace, BeamPlace}


def _insist_on_field(info: LogInfo, tick: Any, field_name: str, lacks: str) -> None:
    if field_name not in tick.DESCRIPTOR.fields_by_name:
        version = info.metadata.get("versions", {}).get("fitctl", "of unknown version")
        msg = (
            f"{info.path}: was recorded by an older fitctl ({version}), whose logs {lacks}; "
            "without these a run cannot be replayed"
        )
        raise LogError(msg)


def _insist_on_start(info: LogInfo, first_ns: int) -> None:
    late_s = first_ns / 1e9 - sum(clock_of(info.path, info.metadata))
    if late_s > _AT_THE_START_S:
        raise _midst(info, f"its first record is of {late_s:.0f} s after the run's start")


def _midst(info: LogInfo, why: str) -> LogError:
    return LogError(
        f"{info.path}: begins in the middle of a run ({why}), and earlier records matter, too; name all files "
        "of the run from the first: fitctl replay FIRST SECOND ..."
    )
