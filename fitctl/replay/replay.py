"""A log through today's code: the same supervisor and loops, with devices that do as the log tells.

It is open loop: whatever today's code commands, the frames that follow are those of the log, and show the
stages where they were sent then. So after each tick the stages go on from the log's commands, while the
controllers' own state and the modes stay today's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import msgspec
import numpy as np

from fitctl.config import Rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.pair import Designer
from fitctl.drivers.interface import Devices, LoopDevices
from fitctl.logging.records import (
    AnyRecord,
    CommandRecord,
    ControllerChange,
    DeviceFailure,
    ExperimentStart,
    MetrologyTick,
    ModeChange,
    Overlap,
    PiezoReading,
    QuantityReading,
    Tick,
)
from fitctl.logging.schemas import fields_of
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.modes import Mode
from fitctl.replay.devices import (
    LoggedCamera,
    LoggedClock,
    LoggedExecutor,
    LoggedLink,
    LoggedMirror,
    LoggedPhotodiodes,
    LoggedServo,
    NoDevice,
    az_el,
    logged_error,
)
from fitctl.replay.log import LoggedStep
from fitctl.replay.result import (
    METROLOGY_COMPARED,
    OVERLAP_COMPARED,
    STELLAR_COMPARED,
    LoopReplay,
    ReplayResult,
)
from fitctl.stages.journal import Journal
from fitctl.stages.siderostat import SiderostatStage
from fitctl.supervisor.supervisor import GOES_TO_BIAS, Supervisor
from fitctl.text import UNDECODABLE

# Who commands is not replayed; a sequence leads to commands of its own, which are in the log as well. What a
# collector that moves does to the stars and the beam is in what was measured, and when frames came is logged.
_NOT_REPLAYED = {"SequenceControl", "TakeOver", "MoveCollector", "FrameRate"}
_RENAMED = {"Hold": "Release"}  # commands of older logs
_OF_CONTROLLERS = {"SetController", "LearnerReport"}


class Replay:
    """A supervisor whose devices are a log.

    Parameters
    ----------
    rig : Rig
        With the log's loops.
    keep_controllers : bool
        The controllers that the rig begins with stay, whatever the log's commands and learner changed.
    """

    def __init__(self, rig: Rig, *, keep_controllers: bool = False) -> None:
        self._left_out = _NOT_REPLAYED | (_OF_CONTROLLERS if keep_controllers else set())
        self._compared = {
            name: METROLOGY_COMPARED if name in rig.metrology_loops else STELLAR_COMPARED
            for name in rig.loops
        }
        self._overlap_of = None if rig.fringes is None else rig.fringes.loops[0]
        self.result = ReplayResult(
            {
                name: LoopReplay.of(
                    compared | (OVERLAP_COMPARED if name == self._overlap_of else {})
                )
                for name, compared in self._compared.items()
            }
        )
        self._clock = LoggedClock()
        self._camera = LoggedCamera()
        self._executor = LoggedExecutor()
        self._servos = {name: LoggedServo(name, rig, self._clock) for name in rig.loops}
        self._mirrors = {name: LoggedMirror(name, rig, self._clock) for name in rig.stellar_loops}
        self._photodiodes = {name: LoggedPhotodiodes(name) for name in rig.metrology_loops}
        nothing = NoDevice()
        devices = {name: LoopDevices(nothing, nothing, nothing) for name in rig.stellar_loops} | {
            name: LoopDevices(nothing, photodiodes=diodes)
            for name, diodes in self._photodiodes.items()
        }
        self._supervisor = Supervisor(
            rig,
            Devices(self._camera, devices),
            self._clock,
            self._executor,
            self._receive,
            design_for,
            self._make_loop,
        )
        for name, loop in self._supervisor.stellar_loops.items():
            if loop.star_motion.link is not None:
                loop.star_motion.link.servo = LoggedLink(self._servos[name])
        self._step = LoggedStep()
        self._waiting: set[str] = set()
        self._overlap: Overlap | None = None

    def _make_loop(
        self, name: str, rig: Rig, _devices: LoopDevices, journal: Journal, design: Designer
    ) -> Loop:
        siderostat = SiderostatStage(rig, name, self._servos[name])
        if name in self._photodiodes:
            return MetrologyLoop(name, rig, siderostat, self._photodiodes[name], journal)
        return StellarLoop(
            name, rig, siderostat, self._mirrors[name], journal, design(rig, name, "")
        )

    def play(self, step: LoggedStep) -> None:
        """Make one step as it was made then, and compare its ticks with the log's."""
        self._step, self._waiting, self._overlap = step, set(step.ticks), None
        self.result.records_lost = max(self.result.records_lost, step.records_lost)
        self._load_step(step)
        self._supervisor.step()
        for name in self._waiting:  # today they are OFF, which gives no tick
            self._compare(name, None)
        self._compare_overlap(step.overlap, self._overlap)

    def _load_step(self, step: LoggedStep) -> None:
        supervisor = self._supervisor
        for reading in step.of(QuantityReading):
            self._clock.set(reading.time_s)
            supervisor.report_quantity(reading.name, reading.value)
        self._clock.set(_begin_s(step))
        self._camera.load_step(step)
        self._executor.load_step(step)
        for name, servo in self._servos.items():
            servo.load_step(step)
            self._load_before_tick(step, name)
        for mirror in self._mirrors.values():
            mirror.load_step(step)
        for photodiodes in self._photodiodes.values():
            photodiodes.load_step(step)
        for reading in step.of(PiezoReading):
            supervisor.piezos[reading.loop].evaluate(_piezo_answer(reading))
        for command in step.of(CommandRecord):
            if not command.accepted and GOES_TO_BIAS not in command.text:
                continue
            if command.command not in self._left_out:
                self._post(command)
            elif command.command == "SetController":
                self.result.controllers_left_out += 1

    def _load_before_tick(self, step: LoggedStep, name: str) -> None:
        """What one loop knows beside its devices' answers."""
        for failure in step.of(DeviceFailure, name):
            if failure.device == "piezo":
                self._supervisor.piezos[name].evaluate(_piezo_answer(failure))
        loop = self._supervisor.loops[name]
        for place in step.of(loop.place_kind, name):
            loop.recall(loop.place_kind(**fields_of(loop.place_kind, place)))

    def _post(self, message: Any) -> None:
        try:
            arguments = msgspec.json.decode(message.values_json, type=dict[str, Any])
            given = arguments | {
                "type": _RENAMED.get(message.command, message.command),
                "loop": message.loop,
            }
            command = msgspec.convert(given, AnyCommand)
        except UNDECODABLE as error:
            self._answered(message, Reply(accepted=False, text=f"not a command: {error}"))
            return
        self._supervisor.post(command, lambda reply: self._answered(message, reply))

    def _answered(self, message: Any, reply: Reply) -> None:
        if message.accepted and not reply.accepted:
            self.result.refused.append(f"{message.command}: {reply.text}")

    def _receive(self, record: AnyRecord) -> None:
        """What today's supervisor records, while it does."""
        match record:
            case ControllerChange():
                self._servos[record.loop].changed()
            case ModeChange():
                then = self._servos[record.loop].changed()
                if then is not None and record.source != record.target:
                    # A loop that waits for this one's counts from here, to the last bit.
                    self._supervisor.loops[record.loop].mode_since_s = then.time_s
            case Overlap():
                self._overlap = record
            case Tick() | MetrologyTick() if record.loop in self._waiting:
                self._waiting.remove(record.loop)
                self._compare(record.loop, record)

    def _compare_overlap(self, then: Any, now: Overlap | None) -> None:
        """The log's and today's overlap on one frame; without one of them, as if its stars were not held."""
        any_of = then or now
        if any_of is None or self._overlap_of is None:
            return
        found = self.result.loops[self._overlap_of]
        for what, fields in OVERLAP_COMPARED.items():
            logged, values = (
                tuple(math.nan if one is None else getattr(one, part) for part in fields)
                for one in (then, now)
            )
            found.differences[what].add(any_of.time_s, logged, values)

    def _compare(self, name: str, now: Tick | MetrologyTick | None) -> None:
        then, mirror, found = (
            self._step.ticks[name],
            self._mirrors.get(name),
            self.result.loops[name],
        )
        found.ticks += 1
        found.frames_missing += then.number >= 0 and self._step.frame is None
        mode = Mode.OFF.name if now is None else now.mode
        found.mode.add(then.time_s, then.mode, mode)
        if now is not None and mode == then.mode:
            for what, fields in self._compared[name].items():
                values = (
                    tuple(mirror.wanted_v.tolist())
                    if what == "stacks_v" and mirror is not None
                    else tuple(getattr(now, part) for part in fields)
                )
                logged = tuple(getattr(then, part) for part in fields)
                found.differences[what].add(then.time_s, logged, values)
        if mirror is not None:
            mirror.follow()
        loop = self._supervisor.loops[name]
        loop.siderostat.setpoint_rad = az_el(then, "siderostat_setpoint")
        loop.quantities.record_tick(then.compute_s, then.time_s)
        self._clock.set(then.time_s)
        if not self._waiting:
            self._clock.set(self._step.reported_s)
        if math.isnan(self.result.start_s):
            self.result.start_s = then.time_s
        self.result.end_s = then.time_s


def replay(
    rig: Rig,
    steps: Iterator[LoggedStep],
    on_tick: Callable[[float], None] = lambda _: None,
    *,
    keep_controllers: bool = False,
) -> ReplayResult:
    """Replay a log's steps; `on_tick` is called now and then with how far that is, in seconds of the log."""
    running = Replay(rig, keep_controllers=keep_controllers)
    started = shown = time.perf_counter()
    for step in steps:
        running.play(step)
        if time.perf_counter() - shown > 0.1:
            shown = time.perf_counter()
            on_tick(np.nan_to_num(running.result.end_s - running.result.start_s))
    running.result.wall_s = time.perf_counter() - started
    return running.result


def _begin_s(step: LoggedStep) -> float:
    """When a step began: its experiment's start, which counts to the last bit, or its first tick's."""
    for name in step.ticks:
        for experiment in step.of(ExperimentStart, name):
            return float(experiment.time_s)
    for tick in step.ticks.values():
        return float(tick.time_s - tick.compute_s)
    return step.begin[0].message.time_s if step.begin else math.nan


def _piezo_answer(message: Any) -> Future:
    """A piezo amplifier's answer, or its error."""
    future: Future = Future()
    if hasattr(message, "error"):
        future.set_exception(logged_error(message.kind, message.error))
    else:
        future.set_result(PiezoReading(**fields_of(PiezoReading, message)))
    return future
