"""The supervisor: frames in, ticks of every loop out, commands and device work in between.

:meth:`Supervisor.step` is the whole of it, run once a frame by the process (:mod:`fitctl.daemon.run`)
on the machine's clock and by the simulation (:mod:`fitctl.simulation.simulation`) on the virtual one. What
may take longer than a tick (opening, closing and polling devices) is handed to `executor`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import msgspec

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.pair import Designer
from fitctl.drivers.interface import Devices, Frame, LoopDevices
from fitctl.logging.records import (
    CAMERA,
    AnyRecord,
    Event,
    FrameRecord,
    LoopTiming,
    Place,
    QuantityReading,
    Severity,
)
from fitctl.loop.learning import refused_report
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop, metrology_loop
from fitctl.loop.overlap import OverlapMeter
from fitctl.loop.stellar import StellarLoop, stellar_loop
from fitctl.messages.command_table import ROWS, command_record, why_too_late
from fitctl.messages.commands import (
    Acquire,
    AnyCommand,
    Experiment,
    FrameRate,
    LearnerReport,
    MoveCollector,
    Off,
    Recover,
    Release,
    Reply,
    SequenceControl,
    SequenceReport,
    SetController,
    Shutdown,
    Standby,
    Stop,
)
from fitctl.messages.modes import POINTING, Mode, Trigger
from fitctl.stages.journal import Journal
from fitctl.stages.periodic import Periodic
from fitctl.stages.servo_group import servo_groups
from fitctl.supervisor.camera_watch import CameraWatch
from fitctl.supervisor.collector import CollectorWatch
from fitctl.supervisor.design_jobs import DesignJobs
from fitctl.supervisor.device_jobs import DeviceJobs, Ended
from fitctl.supervisor.frame_rate import FrameRateChange
from fitctl.supervisor.health import (
    camera_health,
    hexapod_health,
    mirror_health,
    photodiode_health,
    siderostat_health,
)
from fitctl.supervisor.loop_commands import LOOP_COMMANDS, obey_loop_command, why_no_search
from fitctl.supervisor.outcomes import Outcomes
from fitctl.supervisor.piezo import PiezoWatch
from fitctl.supervisor.sequence_board import SequenceBoard
from fitctl.supervisor.timing import TimingBook

_COMMANDS: dict[type[AnyCommand], Trigger] = {
    Standby: Trigger.STANDBY,
    Acquire: Trigger.ACQUIRE,
    Release: Trigger.RELEASE,
    Stop: Trigger.STOP,
    Recover: Trigger.RECOVER,
    Off: Trigger.OFF,
}
_WITHOUT_DEVICES = {Trigger.STOP, Trigger.RELEASE}  # obeyed also while devices are opened or closed
GOES_TO_BIAS = "is on its way to its bias"
"""In the answer to an `Off` that is refused, but moves a mirror."""
_POWER_UP = {Trigger.STANDBY, Trigger.RECOVER}
MakeLoop = Callable[[str, Rig, LoopDevices, Journal, Designer], Loop]


def loop_of_kind(
    name: str, rig: Rig, devices: LoopDevices, journal: Journal, design: Designer
) -> Loop:
    """A loop of the kind in the rig file, on its devices."""
    if name in rig.metrology_loops:
        return metrology_loop(name, rig, devices, journal)
    return stellar_loop(name, rig, devices, journal, design)


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
    design : Designer
        Makes the design of a loop, at the start and for `SetController`.
    make_loop : callable
        Makes a loop of its name, the rig, its devices, the journal and `design`.
    design_executor : Executor, optional
        Makes designs beside the device work, which cannot wait for them; by default `executor`.
    record_frames : bool
        Whether `record` wants the frames too.
    """

    def __init__(
        self,
        rig: Rig,
        devices: Devices,
        clock: Clock,
        executor: Executor,
        record: Callable[[AnyRecord], None],
        design: Designer,
        make_loop: MakeLoop = loop_of_kind,
        design_executor: Executor | None = None,
        *,
        record_frames: bool = True,
    ) -> None:
        self.rig = rig
        journal = Journal(clock, record)
        self.loops = {
            name: make_loop(name, rig, devices.loops[name], journal, design) for name in rig.loops
        }
        for loop in self.loops.values():
            loop.join(self.loops)
        # A stellar loop uses what the metrology loop of its link has decided in the same step.
        self._in_order = sorted(
            self.loops.values(), key=lambda loop: loop.name not in rig.metrology_loops
        )
        self._overlap = None if rig.fringes is None else OverlapMeter(rig, self.loops)
        self.servos = {name: loop.servo for name, loop in self.loops.items()}
        self.sequences = SequenceBoard(journal)
        self.outcomes = Outcomes(rig.loops, clock)
        self.shutdown_wanted = False
        self._closed = False
        self._clock = clock
        self._record = record
        self._record_frames = record_frames
        self._commands: deque[Posted] = deque()
        self._left: deque[AnyRecord] = deque()
        self._quantities: deque[QuantityReading] = deque()
        self._design_jobs = DesignJobs(
            rig,
            self.stellar_loops,
            clock,
            design_executor or executor,
            journal,
            self.outcomes,
            design,
        )
        self._mirrors = [loop.mirror for loop in self.stellar_loops.values()]
        self._reported_s = clock.now_s()
        self.piezos = {
            name: PiezoWatch(loop, piezo, executor, journal)
            for name, loop in self.stellar_loops.items()
            if (piezo := devices.loops[name].piezo) is not None
        }
        self._camera = CameraWatch(rig, devices.camera, clock, self._camera_failed)
        self._device_jobs = DeviceJobs(
            devices, self.loops, self.piezos, self._camera, executor, journal
        )
        self._frame_rate = FrameRateChange(
            rig,
            devices.camera,
            lambda: self._camera.opening,
            executor,
            journal,
            self._camera_failed,
        )
        self.collector = (
            CollectorWatch(rig.collector, devices.hexapod, clock, self.report_event)
            if rig.collector is not None and devices.hexapod is not None
            else None
        )
        self._asked_rates: dict[str, tuple[float, float]] = {}  # by loop: which, and when
        self._rig_commands: dict[type[AnyCommand], Callable[[Any], str]] = {
            MoveCollector: self._move_collector,
            FrameRate: self._change_frame_rate,
        }
        self._timing = TimingBook(clock, rig, self._timed)
        self._servo_groups = servo_groups(devices, self.servos, clock)

    # ------------------------------------------------------------ from any thread

    def post(
        self,
        command: AnyCommand,
        reply: Callable[[Reply], None],
        sender: str = "",
        address: str = "",
    ) -> None:
        """Leave a command for the next step; `reply` is called from there.

        A stop takes the velocity from the siderostats, and stops the hexapod, here and now; the rest follows
        at the next step.
        """
        if isinstance(command, Stop) and (names := self._named(command)):
            self._stop_collector()
            for name in names:
                self.loops[name].servo.stop()
        self._commands.append(Posted(command, reply, sender, address))
        if self._closed:  # no step follows
            self._end_posted()

    def report_event(self, severity: Severity, source: str, message: str) -> None:
        """Leave an event for the next step, from any thread."""
        now_s = self._clock.now_s()
        self.leave(Event(time_s=now_s, severity=severity, source=source, message=message))

    def leave(self, record: AnyRecord) -> None:
        """Leave a record for the next step, from any thread."""
        self._left.append(record)

    def report_quantity(self, name: str, value: float) -> None:
        """Leave a quantity of all loops, for their interlocks, for the next step; from any thread."""
        reading = QuantityReading(time_s=self._clock.now_s(), name=name, value=value)
        self._quantities.append(reading)

    def modes_of(self, names: Iterable[str]) -> str:
        """The modes of some loops, for people."""
        return ", ".join(f"{name} {self.loops[name].mode.name}" for name in names)

    @property
    def stellar_loops(self) -> dict[str, StellarLoop]:
        """The loops that point a star."""
        return {name: loop for name, loop in self.loops.items() if isinstance(loop, StellarLoop)}

    @property
    def periodic(self) -> list[Periodic]:
        """What runs at a pace of its own, beside the frames."""
        drives = [] if self.collector is None else [self.collector.drive]
        grouped = [servo for group in self._servo_groups for servo in group.servos]
        each = [work for loop in self.loops.values() for work in loop.periodic]
        return [*self._servo_groups, *(work for work in each if work not in grouped), *drives]

    @property
    def places(self) -> list[Place]:
        """Where the loops know their stars and beams to be, for :meth:`recall` of a supervisor after this."""
        places = (loop.place for loop in self.loops.values())
        return [place for place in places if place is not None]

    def recall(self, places: Iterable[Place]) -> None:
        """Know where a supervisor that was killed had its stars and beams; called before the first step."""
        now_s = self._clock.now_s()
        for place in places:
            loop = self.loops.get(place.loop)
            # A place of later than now is from before the computer restarted.
            if loop is not None and isinstance(place, loop.place_kind) and place.time_s <= now_s:
                loop.recall(place)

    # ------------------------------------------------------------ once a frame

    def step(self) -> None:
        """Wait for the next frame, no longer than two frame periods, and act on it.

        Until it comes, mirrors are written that are due.
        Every loop has sent its stages what they are to do before the first waits for a confirmation.
        """
        loops = self._in_order
        were_safe = [loop.mode is Mode.SAFE for loop in loops]
        frame = self._camera.next_frame(self._write_due)
        self._finish_jobs()
        self._obey_posted()
        self._frame_rate.check()
        self.record_left()
        lost = self._camera.counts.lost if self._camera.ready else 0
        for loop in loops:
            loop.sense(frame, lost, self._camera.skipped)
            loop.decide()
            loop.send()
        for loop in loops:
            loop.confirm()
        for loop, was_safe in zip(loops, were_safe, strict=True):
            tick = loop.tick_record()
            if frame is not None or loop.mode is not Mode.OFF:
                self._record(tick)
            self._timing.add(tick)
            self._make_safer(loop, was_safe=was_safe)
        self._design_jobs.observe_light()
        self.outcomes.observe(self.loops)
        if self.collector is not None:
            self.collector.check()
        if frame is not None and self._overlap is not None and self.pointing:
            self._record(self._overlap.measure(frame))
        if self._record_frames:
            for older in self._camera.older:
                self._record_frame(older)
            if frame is not None:
                self._record_frame(frame)
        if not self._device_jobs.busy:
            for piezo in self.piezos.values():
                piezo.ask()
        if self._clock.now_s() - self._reported_s >= 1.0:
            self._once_a_second()

    def _write_due(self) -> float:
        """Write the mirrors that are due between frames; when the next is."""
        return min((mirror.write_due() for mirror in self._mirrors), default=math.inf)

    def _record_frame(self, frame: Frame) -> None:
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

    def stop(self, reason: str) -> None:
        """Every loop to SAFE, the collector stopped, and devices that are being opened closed again."""
        self._stop_collector()
        self._device_jobs.abandon(list(self.loops))
        for loop in self.loops.values():
            loop.fire(Trigger.STOP, reason)
        now_s = self._clock.now_s()
        self._record(command_record(Stop(), Reply(accepted=True, text=reason), "fitctl", "", now_s))

    @property
    def pointing(self) -> bool:
        """A loop has its star or its beam, or looks for it."""
        return any(loop.mode in POINTING for loop in self.loops.values())

    def at_rest(self) -> bool:
        """Every stage that can still be commanded is where it may be left without power."""
        return all(loop.at_rest() for loop in self.loops.values())

    def close(self) -> None:
        """Disable and close all devices, from every state; the supervisor accepts no command afterwards."""
        self.shutdown_wanted = True
        self._obey_posted()
        self._closed = True  # devices that answer slowly keep nobody waiting for an answer
        self._end_posted()
        self._stop_collector()
        try:
            self._device_jobs.close_all()
        finally:
            if self.collector is not None:
                self.collector.close()
            self.record_left()

    def _stop_collector(self) -> None:
        if self.collector is not None:
            self.collector.stop()

    def _camera_failed(self, error: Exception) -> None:
        self._camera.ready = False
        for loop in self.stellar_loops.values():
            loop.device_failed(CAMERA, error)

    def record_left(self) -> None:
        """Record what was left since the last step; after :meth:`close`, also what the service left since."""
        while self._left:
            self._record(self._left.popleft())
        while self._quantities:
            reading = self._quantities.popleft()
            for loop in self.loops.values():
                loop.quantities.put(reading.name, reading.value, reading.time_s)
            self._record(reading)

    # ------------------------------------------------------------ commands

    def _taken(self) -> Iterator[Posted]:
        """The commands that wait, each for one thread."""
        with suppress(IndexError):
            while True:
                yield self._commands.popleft()

    def _obey_posted(self) -> None:
        for posted in self._taken():
            why_not = why_too_late(posted.command, self._clock.now_s())
            reply = _refusal(why_not) if why_not else self._obey(posted.command)
            self._answer(posted, reply, self._record)

    def _end_posted(self) -> None:
        """Answer what came after the end, on any thread: all is stopped already."""
        for posted in self._taken():
            stops = isinstance(posted.command, Stop)
            self._answer(posted, Reply(accepted=stops, text="shutting down"), self.leave)

    def _answer(self, posted: Posted, reply: Reply, record: Callable[[AnyRecord], None]) -> None:
        if ROWS[type(posted.command)].logged:
            now_s = self._clock.now_s()
            record(command_record(posted.command, reply, posted.sender, posted.address, now_s))
        posted.reply(reply)

    def _named(self, command: AnyCommand) -> list[str]:
        return [name for name in self.loops if command.loop in {"", name}]

    def _obey(self, command: AnyCommand) -> Reply:
        names = self._named(command)
        if not names:
            return _refusal(f"no loop is named {command.loop}; the rig has {', '.join(self.loops)}")
        if isinstance(command, Stop):
            self._stop_collector()  # a start that came before the stop was obeyed only now
        if isinstance(command, Shutdown):
            self.shutdown_wanted = True
            return Reply(accepted=True, text="shutting down")
        if self.shutdown_wanted and not isinstance(command, Stop):
            return _refusal("shutting down")
        if isinstance(command, LearnerReport):
            return self._learn(command, names)
        return self._obey_for(command, names)

    def _obey_for(self, command: AnyCommand, names: list[str]) -> Reply:
        match command:
            case SetController():
                return self._design_jobs.begin(command, names)
            case SequenceReport():
                if not self.sequences.under_way:
                    self._frame_rate.end()
                return self.sequences.report(command.status)
            case SequenceControl():
                return self.sequences.control(command.action)
            case _ if type(command) in _COMMANDS:
                return self._fire(_COMMANDS[type(command)], names, command)
            case _ if type(command) in self._rig_commands:
                why_not = self._rig_commands[type(command)](command)
                return _refusal(why_not) if why_not else Reply(accepted=True)
            case _ if type(command) in LOOP_COMMANDS:
                why_not = self._obey_for_loops(command, names)
            case _:
                why_not = f"{type(command).__name__} is not for the supervisor"
        return _refusal(why_not) if why_not else self._begin(command, names)

    def _move_collector(self, command: MoveCollector) -> str:
        if self.collector is None:
            return "the rig has no collector that moves"
        return self.collector.obey(command)

    def _obey_for_loops(self, command: AnyCommand, names: list[str]) -> str:
        if isinstance(command, Experiment) and self._frame_rate.active:
            return (
                "experiment needs the rig's frame rate; wait until the camera runs as usual again"
            )
        return obey_loop_command(self.rig, [self.loops[name] for name in names], command)

    def _why_no_other_rate(self) -> str:
        if self._device_jobs.busy:
            return "devices are being opened or closed; wait for the event that reports the end"
        if any(loop.mode is Mode.EXPERIMENT for loop in self.loops.values()):
            return "an experiment needs the rig's frame rate; wait for its end"
        return ""

    def _change_frame_rate(self, command: FrameRate) -> str:
        why_not = self._why_no_other_rate() or self._frame_rate.why_not(
            command.rate_hz, command.duration_s
        )
        if not why_not:
            self._frame_rate.begin(command.rate_hz, command.duration_s)
        return why_not

    def _fire(self, trigger: Trigger, names: list[str], command: AnyCommand) -> Reply:
        if isinstance(command, Acquire):
            why_not = why_no_search(self.rig, [self.loops[name] for name in names], command)
            if why_not:
                return _refusal(why_not)
        usable = [name for name in names if trigger in self.loops[name].usable_commands]
        if not usable:
            return _refusal(self._why_not(trigger, names))
        if self._device_jobs.busy and trigger not in _WITHOUT_DEVICES:
            return _refusal(
                "devices are being opened or closed; wait for the event that reports the end"
            )
        moving = self._rest_mirrors(usable) if trigger is Trigger.OFF else []
        if moving:
            return _refusal(f"mirror {', '.join(moving)} {GOES_TO_BIAS}; try again")
        reply = self._begin(command, usable)
        ended = partial(self.outcomes.end, reply.number, usable)
        if trigger in _POWER_UP:
            self._device_jobs.open(usable, trigger, ended)
        elif trigger is Trigger.OFF:
            self._turn_off(usable, ended)
        else:
            if trigger is Trigger.STOP:
                self._device_jobs.abandon(usable)
            for loop in self._in_order:
                if loop.name in usable:
                    loop.obey(trigger, command)
            if trigger is Trigger.STOP:
                return msgspec.structs.replace(reply, text=self.modes_of(usable))
        return reply

    def _turn_off(self, names: list[str], ended: Ended) -> None:
        """Close the devices of these loops, and stop the collector if that was the last of the loops."""
        self._device_jobs.turn_off(names, ended)
        if all(loop.mode is Mode.OFF for loop in self.loops.values()):
            self._stop_collector()

    def _rest_mirrors(self, names: list[str]) -> list[str]:
        """Send these loops' mirrors to rest at the next ticks; return the loops with a moving mirror."""
        moving = [name for name in names if not self.loops[name].at_rest()]
        for name in moving:
            self.loops[name].rest()
        return moving

    def _begin(self, command: AnyCommand, names: list[str]) -> Reply:
        return Reply(accepted=True, number=self.outcomes.begin(command, names))

    def _why_not(self, trigger: Trigger, names: list[str]) -> str:
        loop = self.loops[names[0]]
        if self._device_jobs.opens(loop.name):
            return f"{trigger.name.lower()} is not available while devices are opened; wait for STANDBY"
        mode, can = loop.mode, ", ".join(t.name.lower() for t in loop.usable_commands)
        return f"{trigger.name.lower()} is not available in {mode.name}. Available: {can}"

    def _learn(self, report: LearnerReport, names: list[str]) -> Reply:
        loop = self.stellar_loops.get(report.loop)
        if loop is None:
            return _refusal(f"a report on learning is on one stellar loop, not {', '.join(names)}")
        why_not = refused_report(report)
        if why_not:
            return _refusal(why_not)
        self._design_jobs.learn(loop, report)
        self._asked_rates[loop.name] = (report.classifying_rate_hz, self._clock.now_s())
        return Reply(accepted=True)

    # ------------------------------------------------------------ beside the ticks

    def _make_safer(self, loop: Loop, *, was_safe: bool) -> None:
        """In SAFE the collector stops, and after a while the loop has no power, unless it is given some now."""
        if loop.mode is Mode.SAFE and not was_safe:
            self._stop_collector()
        if not was_safe:
            return
        lasted_s = self._clock.now_s() - loop.mode_since_s
        being_opened = self._device_jobs.opens(loop.name)
        if lasted_s > self.rig.supervisor.safe_disable_after_s and not being_opened:
            loop.servo.disable()

    def _finish_jobs(self) -> None:
        were_busy = self._device_jobs.busy
        self._device_jobs.finish()
        if were_busy and not self._device_jobs.busy:
            self._reported_s = -math.inf  # consoles show at once what was opened or closed
        self._design_jobs.finish()
        for piezo in self.piezos.values():
            piezo.collect()

    # ------------------------------------------------------------ once a second

    def _once_a_second(self) -> None:
        now_s = self._reported_s = self._clock.now_s()
        self._change_rate_for_learner(now_s)
        # Nothing is timed while devices are let go or being opened: imports and parsing hold everything.
        if not self._device_jobs.busy:
            self._timing.report(
                {
                    name: self.servos[name]
                    for name in self.loops
                    if self.loops[name].mode is not Mode.OFF
                }
            )
        camera, identities = self._camera, self._device_jobs.identities
        self._record(
            camera_health(self.rig, camera.counts, camera.skipped, camera.well, identities, now_s)
        )
        for name, loop in self.loops.items():
            self._record(siderostat_health(loop, identities, now_s))
            if isinstance(loop, MetrologyLoop):
                self._record(photodiode_health(loop, identities, now_s))
            elif isinstance(loop, StellarLoop) and name in self.piezos:
                piezo = self.piezos[name]
                loop.quantities.record_piezo_error(piezo.error, now_s)
                for row in mirror_health(loop, piezo, identities, now_s):
                    self._record(row)
        # Before the collector is to move, nobody has asked for the hexapod.
        if self.collector is not None and (self.collector.is_open or self.collector.error):
            self._record(hexapod_health(self.collector, now_s))

    def _change_rate_for_learner(self, now_s: float) -> None:
        """Change the frame rate if a learner has asked for it lately, once its design is in use."""
        if self._design_jobs.busy or self.sequences.under_way or self._why_no_other_rate():
            return
        for name, loop in self.stellar_loops.items():
            if name in self._asked_rates and loop.learning.may_act(now_s):
                self._frame_rate.for_learner(*self._asked_rates[name])

    def _timed(self, record: LoopTiming) -> None:
        self.loops[record.loop].quantities.record_timing(record)
        self._record(record)


def _refusal(text: str) -> Reply:
    return Reply(accepted=False, text=text)
