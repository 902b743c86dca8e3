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
    ModeChange,
    PiezoReading,
    QuantityReading,
    Tick,
)
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.modes import Mode
from fitctl.replay.devices import (
    LoggedCamera,
    LoggedClock,
    LoggedExecutor,
    LoggedMirror,
    LoggedServo,
    NoDevice,
    az_el,
    logged_error,
)
from fitctl.replay.log import LoggedStep
from fitctl.replay.result import COMPARED, LoopReplay, ReplayResult
from fitctl.stages.journal import Journal
from fitctl.stages.siderostat import SiderostatStage
from fitctl.supervisor.supervisor import Supervisor

# Who commands is not replayed; a sequence leads to commands of its own, which are in the log as well.
_OF_PEOPLE = {"SequenceControl", "TakeOver"}


class Replay:
    """A supervisor whose devices are a log.

    Parameters
    ----------
    rig : Rig
        With the log's loops.
    """

    def __init__(self, rig: Rig) -> None:
        self.result = ReplayResult({name: LoopReplay() for name in rig.loops})
        self._clock = LoggedClock()
        self._camera = LoggedCamera()
        self._executor = LoggedExecutor()
        self._servos = {name: LoggedServo(name, rig, self._clock) for name in rig.loops}
        self._mirrors = {name: LoggedMirror(name, rig, self._clock) for name in rig.loops}
        nothing = NoDevice()
        devices = {name: LoopDevices(nothing, nothing, nothing) for name in rig.loops}
        self._supervisor = Supervisor(
            rig,
            Devices(self._camera, devices),
            self._clock,
            self._executor,
            self._receive,
            design_for,
            self._make_loop,
        )
        self._step = LoggedStep()
        self._waiting: set[str] = set()

    def _make_loop(
        self, name: str, rig: Rig, _devices: LoopDevices, journal: Journal, design: Designer
    ) -> StellarLoop:
        siderostat = SiderostatStage(rig, name, self._servos[name])
        return StellarLoop(
            name, rig, siderostat, self._mirrors[name], journal, design(rig, name, "")
        )

    def play(self, step: LoggedStep) -> None:
        """Make one step as it was made then, and compare its ticks with the log's."""
        self._step, self._waiting = step, set(step.ticks)
        self.result.records_lost = max(self.result.records_lost, step.records_lost)
        self._load_step(step)
        self._supervisor.step()
        for name in self._waiting:  # today they are OFF, which gives no tick
            self._compare(name, None)

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
            self._mirrors[name].load_step(step)
            for failure in step.of(DeviceFailure, name):
                if failure.device == "piezo":
                    supervisor.piezos[name].evaluate(_piezo_answer(failure))
        for reading in step.of(PiezoReading):
            supervisor.piezos[reading.loop].evaluate(_piezo_answer(reading))
        for command in step.of(CommandRecord):
            # A refused Off takes the mirror to its bias.
            if command.command not in _OF_PEOPLE and (command.accepted or command.command == "Off"):
                self._post(command)

    def _post(self, message: Any) -> None:
        try:
            arguments = msgspec.json.decode(message.values_json)
            given = arguments | {"type": message.command, "loop": message.loop}
            command = msgspec.convert(given, AnyCommand)
        except msgspec.MsgspecError as error:
            self._answered(message, Reply(accepted=False, text=f"not a command: {error}"))
            return
        self._supervisor.post(command, lambda reply: self._answered(message, reply))

    def _answered(self, message: Any, reply: Reply) -> None:
        if message.accepted and not reply.accepted:
            self.result.refused.append(f"{message.command}: {reply.text}")

    def _receive(self, record: AnyRecord) -> None:
        """What today's supervisor records, while it does."""
        match record:
            case ModeChange() | ControllerChange():
                self._servos[record.loop].changed()
            case Tick() if record.loop in self._waiting:
                self._waiting.remove(record.loop)
                self._compare(record.loop, record)

    def _compare(self, name: str, now: Tick | None) -> None:
        then, mirror, found = self._step.ticks[name], self._mirrors[name], self.result.loops[name]
        found.ticks += 1
        found.frames_missing += then.number >= 0 and self._step.frame is None
        mode = Mode.OFF.name if now is None else now.mode
        found.mode.add(then.time_s, then.mode, mode)
        if now is not None and mode == then.mode:
            for what, fields in COMPARED.items():
                values = (
                    tuple(mirror.wanted_v.tolist())
                    if what == "stacks_v"
                    else tuple(getattr(now, part) for part in fields)
                )
                logged = tuple(getattr(then, part) for part in fields)
                found.differences[what].add(then.time_s, logged, values)
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
    rig: Rig, steps: Iterator[LoggedStep], on_tick: Callable[[float], None] = lambda _: None
) -> ReplayResult:
    """Replay a log's steps; `on_tick` is called now and then with how far that is, in seconds of the log."""
    running = Replay(rig)
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
        values = {name: getattr(message, name) for name in PiezoReading.__struct_fields__}
        future.set_result(PiezoReading(**values))
    return future
