"""The supervisor: frames in, ticks of every loop out, commands and device work in between.

:meth:`Supervisor.step` is the whole of it, run once a frame by the process (:mod:`fitctl.supervisor.run`)
on the machine's clock and by the simulation (:mod:`fitctl.supervisor.simulate`) on the virtual one. What
may take longer than a tick (opening, closing and polling devices) is handed to `executor`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import NamedTuple

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import (
    DeviceError,
    DeviceIdentity,
    Devices,
    Frame,
)
from fitctl.logging.records import (
    AnyRecord,
    DevicesOpened,
    Event,
    FrameRecord,
    LoopTiming,
    QuantityReading,
    Severity,
)
from fitctl.supervisor.command_table import ROWS, command_record
from fitctl.supervisor.health import camera_health, loop_health
from fitctl.supervisor.loop import StellarLoop
from fitctl.supervisor.loop_commands import LOOP_COMMANDS, why_no_search
from fitctl.supervisor.messages import (
    Acquire,
    AnyCommand,
    Hold,
    Off,
    Recover,
    Reply,
    SequenceControl,
    SequenceReport,
    SetController,
    Shutdown,
    Standby,
    Stop,
)
from fitctl.supervisor.modes import Mode, Trigger, usable_commands
from fitctl.supervisor.periodic import Periodic
from fitctl.supervisor.piezo import PiezoWatch
from fitctl.supervisor.power import CAMERA, Opened, close_devices, open_devices, told
from fitctl.supervisor.sequence_board import SequenceBoard
from fitctl.supervisor.servo import SiderostatServo
from fitctl.supervisor.timing import TimingBook

_CLOSE_TIMEOUT_S = 30.0
_SILENT_FRAMES = 10  # fewer may be missing when the machine stands still
_COMMANDS: dict[type[AnyCommand], Trigger] = {
    Standby: Trigger.STANDBY,
    Acquire: Trigger.ACQUIRE,
    Hold: Trigger.HOLD,
    Stop: Trigger.STOP,
    Recover: Trigger.RECOVER,
    Off: Trigger.OFF,
}
_POWER_UP = {Trigger.STANDBY, Trigger.RECOVER}


class Job(NamedTuple):
    """Device work under way, and what is to be done when it ends."""

    future: Future
    done: Callable[[Future], None]


class Posted(NamedTuple):
    """A command on its way to the next step: whom it answers, and who gave it from where."""

    command: AnyCommand
    reply: Callable[[Reply], None]
    sender: str
    address: str


class Supervisor:
    """One rig under control.

    Parameters
    ----------
    rig : Rig
    devices : Devices
    clock : Clock
    executor : Executor
        Runs device work; must run one piece at a time.
    record : callable
        Takes every record (log and consoles); must not block.
    """

    def __init__(
        self,
        rig: Rig,
        devices: Devices,
        clock: Clock,
        executor: Executor,
        record: Callable[[AnyRecord], None],
    ) -> None:
        self.rig = rig
        self.servos = {
            name: SiderostatServo(
                name, loop, devices.loops[name].amplifiers, clock, rig.camera.period_s
            )
            for name, loop in rig.loops.items()
        }
        self.loops = {
            name: StellarLoop(name, rig, servo, devices.loops[name].dac, clock, record)
            for name, servo in self.servos.items()
        }
        self.sequences = SequenceBoard(clock, record)
        self.shutdown_wanted = False
        self._devices = devices
        self._clock = clock
        self._executor = executor
        self._record = record
        self._commands: deque[Posted] = deque()
        self._left: deque[AnyRecord] = deque()
        self._measured: deque[QuantityReading] = deque()
        self._job: Job | None = None
        self._opening: set[str] = set()
        self._abandoned: set[str] = set()
        self._designs: deque[Job] = deque()
        self._reported_s = clock.now_s()
        self.piezos = {
            name: PiezoWatch(loop, devices.loops[name].piezo, clock, executor, record)
            for name, loop in self.loops.items()
        }
        self._camera_ready = False
        self._last_frame_s = clock.now_s()
        self._identities: dict[str, DeviceIdentity] = {}
        self._timing = TimingBook(clock, rig, self._timed)

    # ------------------------------------------------------------ from any thread

    def post(
        self,
        command: AnyCommand,
        reply: Callable[[Reply], None],
        sender: str = "",
        address: str = "",
    ) -> None:
        """Leave a command for the next step; `reply` is called from there.

        A stop takes the velocity from the siderostats here and now; the rest follows at the next step.
        """
        if isinstance(command, Stop):
            for name in self._named(command):
                self.servos[name].stop()
        self._commands.append(Posted(command, reply, sender, address))

    def note(self, severity: Severity, source: str, message: str) -> None:
        """Leave an event for the next step, from any thread."""
        now_s = self._clock.now_s()
        self.leave(Event(time_s=now_s, severity=severity, source=source, message=message))

    def leave(self, record: AnyRecord) -> None:
        """Leave a record for the next step, from any thread."""
        self._left.append(record)

    def measured(self, name: str, value: float) -> None:
        """Leave a quantity of all loops, for their interlocks, for the next step; from any thread."""
        reading = QuantityReading(time_s=self._clock.now_s(), name=name, value=value)
        self._measured.append(reading)

    @property
    def periodic(self) -> list[Periodic]:
        """What runs at a pace of its own, beside the frames."""
        return [*self.servos.values(), *(loop.stages.injector for loop in self.loops.values())]

    # ------------------------------------------------------------ once a frame

    def step(self) -> None:
        """Wait for the next frame, no longer than two frame periods, and act on it."""
        frame = self._next_frame()
        self._finish_jobs()
        while self._commands:
            posted = self._commands.popleft()
            answer = self._obey(posted.command)
            self._log_command(posted, answer)
            posted.reply(answer)
        while self._left:
            self._record(self._left.popleft())
        while self._measured:
            self._take_measured(self._measured.popleft())
        lost = self._devices.camera.counts().lost if self._camera_ready else 0
        for loop in self.loops.values():
            was_safe = loop.mode is Mode.SAFE
            tick = loop.tick(frame, lost)
            if frame is not None or loop.mode is not Mode.OFF:
                self._record(tick)
            self._timing.add(tick)
            if was_safe:
                self._make_safer(loop)
        if frame is not None:
            self._record(
                FrameRecord(
                    time_s=frame.mid_exposure_s,
                    camera=CAMERA,
                    number=frame.number,
                    width_px=frame.image.shape[1],
                    height_px=frame.image.shape[0],
                    data=frame.image.tobytes(),
                )
            )
        if self._job is None:
            for name, piezo in self.piezos.items():
                if self.loops[name].stages.ready:
                    piezo.ask()
        if self._clock.now_s() - self._reported_s >= 1.0:
            self._once_a_second()

    def stop(self, reason: str) -> None:
        """Every loop to SAFE."""
        for loop in self.loops.values():
            loop.fire(Trigger.STOP, reason)
        now_s = self._clock.now_s()
        self._record(command_record(Stop(), Reply(accepted=True, text=reason), "fitctl", "", now_s))

    def at_rest(self) -> bool:
        """Every mirror that can still be commanded is at its bias."""
        return all(self._at_bias(name) for name in self.loops)

    def _at_bias(self, name: str) -> bool:
        loop = self.loops[name]
        return not loop.stages.ready or loop.stages.at_bias()

    def close(self) -> None:
        """Disable and let go of everything, whatever state it is in."""
        for loop in self.loops.values():
            loop.stages.ready = False
        self._camera_ready = False
        self._submit(close_devices, list(self.loops), True).result(timeout=_CLOSE_TIMEOUT_S)

    # ------------------------------------------------------------ frames

    def _next_frame(self) -> Frame | None:
        period_s = self.rig.camera.period_s
        if not self._camera_ready:
            self._clock.sleep_until(self._clock.now_s() + period_s)
            return None
        try:
            frame = self._devices.camera.next_frame(2 * period_s)
        except DeviceError as error:
            self._camera_lost(error)
            return None
        if frame is not None:
            self._last_frame_s = self._clock.now_s()
        return frame

    @property
    def _camera_well(self) -> bool:
        """It is open, and frames come."""
        camera = self.rig.camera
        silent_s = self._clock.now_s() - self._last_frame_s
        return (
            self._camera_ready
            and silent_s <= camera.frame_delay_s + _SILENT_FRAMES * camera.period_s
        )

    def _camera_lost(self, error: DeviceError) -> None:
        self._camera_ready = False
        for loop in self.loops.values():
            loop.device_failed(CAMERA, error)

    # ------------------------------------------------------------ commands

    def _log_command(self, posted: Posted, reply: Reply) -> None:
        if ROWS[type(posted.command)].logged:
            now_s = self._clock.now_s()
            self._record(
                command_record(posted.command, reply, posted.sender, posted.address, now_s)
            )

    def _take_measured(self, reading: QuantityReading) -> None:
        for loop in self.loops.values():
            loop.measured.put(reading.name, reading.value, reading.time_s)
        self._record(reading)

    def _named(self, command: AnyCommand) -> list[str]:
        return [name for name in self.loops if command.loop in {"", name}]

    def _obey(self, command: AnyCommand) -> Reply:
        names = self._named(command)
        if not names:
            return _refusal(f"no loop is named {command.loop}; there are {', '.join(self.loops)}")
        if isinstance(command, Shutdown):
            self.shutdown_wanted = True
            return Reply(accepted=True, text="shutting down")
        if self.shutdown_wanted and not isinstance(command, Stop):
            return _refusal("shutting down")
        return self._obey_for(command, names)

    def _obey_for(self, command: AnyCommand, names: list[str]) -> Reply:
        loops = [self.loops[name] for name in names]
        match command:
            case SetController():
                return self._set_controller(command, names)
            case SequenceReport():
                return self.sequences.report(command.status)
            case SequenceControl():
                return self.sequences.control(command.action)
            case _ if type(command) in LOOP_COMMANDS:
                why_not = LOOP_COMMANDS[type(command)](self.rig, loops, command)
                return _refusal(why_not) if why_not else Reply(accepted=True)
            case _ if type(command) in _COMMANDS:
                return self._fire(_COMMANDS[type(command)], names, command)
        return _refusal(f"{type(command).__name__} is not for the supervisor")

    def _fire(self, trigger: Trigger, names: list[str], command: AnyCommand) -> Reply:
        if isinstance(command, Acquire):
            why_not = why_no_search(self.rig, [self.loops[name] for name in names], command)
            if why_not:
                return _refusal(why_not)
        usable = [name for name in names if trigger in usable_commands(self.loops[name].mode)]
        if not usable:
            return _refusal(self._why_not(trigger, names))
        if self._job is not None and trigger is not Trigger.STOP:
            return _refusal("devices are being opened or closed; wait for the event that says so")
        if trigger in _POWER_UP:
            self._open(usable, trigger)
        elif trigger is Trigger.OFF:
            moving = [name for name in usable if not self._at_bias(name)]
            for name in moving:
                self.loops[name].stages.mirror_to_bias()  # where it rested off its bias
            if moving:
                return _refusal(f"mirror {', '.join(moving)} is on its way to its bias; try again")
            self._turn_off(usable)
        else:
            if trigger is Trigger.STOP:
                self._abandoned |= self._opening & set(usable)
            for name in usable:
                if isinstance(command, Acquire):
                    self.loops[name].look_for(command)
                self.loops[name].fire(trigger, "operator")
        return Reply(accepted=True)

    def _why_not(self, trigger: Trigger, names: list[str]) -> str:
        mode = self.loops[names[0]].mode
        can = ", ".join(t.name.lower() for t in usable_commands(mode))
        return f"{trigger.name.lower()} means nothing in {mode.name}; from here: {can}"

    def _set_controller(self, command: SetController, names: list[str]) -> Reply:
        for name in names:
            # A design takes longer than a tick.
            future = self._executor.submit(design_for, self.rig, name, command.name)
            self._designs.append(Job(future, partial(self._designed, name, command.name)))
        self._finish_jobs()
        return Reply(accepted=True, text="designing; an event tells when it is at work")

    def _designed(self, name: str, controller: str, future: Future) -> None:
        error = future.exception()
        if error is None:
            self.loops[name].use(future.result())
        else:
            self._event("error", name, f"no design {controller}: {told(error)}")

    # ------------------------------------------------------------ device work

    def _open(self, names: list[str], trigger: Trigger) -> None:
        for name in names:
            self.loops[name].stages.ready = False
            self.piezos[name].forget()
        self._opening, self._abandoned = set(names), set()
        self._event("info", "supervisor", "opening and checking all devices")
        with_camera = not self._camera_well
        self._camera_ready = not with_camera  # nobody asks it for frames while it is opened
        future = self._submit(open_devices, names, with_camera)
        self._job = Job(future, partial(self._opened, names, with_camera, trigger))
        self._finish_jobs()

    def _opened(
        self, names: list[str], with_camera: bool, trigger: Trigger, future: Future
    ) -> None:
        abandoned, self._opening, self._abandoned = bool(self._abandoned), set(), set()
        error = future.exception()
        self._log_opened(names, None if error else future.result(), told(error) if error else "")
        if error is not None:
            self._event("error", "supervisor", f"{trigger.name.lower()} failed: {told(error)}")
            self._close(names, with_camera)
            return
        if abandoned:
            # A stop while devices are being opened has the last word.
            self._event("warning", "supervisor", "stopped while opening; devices let go")
            self._close(names, with_camera)
            return
        opened: Opened = future.result()
        self._identities.update(opened.identities)
        self._camera_ready = True
        self._last_frame_s = self._clock.now_s()
        for name in names:
            loop = self.loops[name]
            loop.start_from(opened.stack_v[name])
            self.piezos[name].begin()
            # Opening imports and parses: what the servo waited meanwhile is no stall of the machine.
            self.servos[name].take_timing()
            loop.fire(trigger, "all devices open, checked and enabled")

    def _log_opened(self, names: list[str], opened: Opened | None, error: str) -> None:
        for name in names:
            v1, v2, v3 = [math.nan] * 3 if opened is None else opened.stack_v[name].tolist()
            self._record(
                DevicesOpened(
                    time_s=self._clock.now_s(),
                    loop=name,
                    stack1_v=v1,
                    stack2_v=v2,
                    stack3_v=v3,
                    encoders_jumped=self.servos[name].encoders_jumped,
                    error=error,
                )
            )

    def _turn_off(self, names: list[str]) -> None:
        for name in names:
            self.loops[name].stages.ready = False
            self.loops[name].fire(Trigger.OFF, "operator")
        # The camera serves all loops; the last one out turns it off.
        with_camera = all(loop.mode is Mode.OFF for loop in self.loops.values())
        self._camera_ready = self._camera_ready and not with_camera
        self._close(names, with_camera)

    def _close(self, names: list[str], with_camera: bool) -> None:
        self._job = Job(self._submit(close_devices, names, with_camera), lambda _: None)

    def _submit(
        self, work: Callable[..., Opened | None], names: list[str], with_camera: bool
    ) -> Future:
        return self._executor.submit(
            work, self._devices, self.servos, names, with_camera, self._closed_badly
        )

    def _closed_badly(self, device: str, error: Exception) -> None:
        self.note("warning", "supervisor", f"{device} did not close well: {told(error)}")

    def _make_safer(self, loop: StellarLoop) -> None:
        if self._clock.now_s() - loop.mode_since_s > self.rig.supervisor.safe_disable_after_s:
            loop.servo.disable()

    def _finish_jobs(self) -> None:
        job = self._job
        if job is not None and job.future.done():
            self._job = None
            job.done(job.future)
        while self._designs and self._designs[0].future.done():
            design = self._designs.popleft()
            design.done(design.future)
        for piezo in self.piezos.values():
            piezo.judge()

    # ------------------------------------------------------------ once a second

    def _once_a_second(self) -> None:
        now_s = self._reported_s = self._clock.now_s()
        # Nothing is timed while devices are let go or being opened: imports and parsing hold everything.
        if self._job is None:
            self._timing.report(
                {
                    name: self.servos[name]
                    for name in self.loops
                    if self.loops[name].mode is not Mode.OFF
                }
            )
        counts = self._devices.camera.counts()
        self._record(camera_health(self.rig, counts, self._camera_well, self._identities, now_s))
        for name, loop in self.loops.items():
            trouble = self.piezos[name].error
            loop.measured.of_piezo_error(trouble, now_s)
            for row in loop_health(loop, trouble, self._identities, now_s):
                self._record(row)

    def _timed(self, record: LoopTiming) -> None:
        self.loops[record.loop].measured.of_timing(record)
        self._record(record)

    def _event(self, severity: Severity, source: str, message: str) -> None:
        self._record(
            Event(
                time_s=self._clock.now_s(),
                severity=severity,
                source=source,
                message=message,
            )
        )


def _refusal(text: str) -> Reply:
    return Reply(accepted=False, text=text)
