"""The instrument of one run: the supervisor on virtual time, its devices, its operators, what happens to it."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import numpy as np

from benchmarks.swarm.clients import Console, Link, RunningSequence
from benchmarks.swarm.computer import Computer
from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.devices.hexapod import SwarmHexapod
from benchmarks.swarm.devices.mirror import SwarmDac, SwarmPiezo
from benchmarks.swarm.devices.sensors import SwarmCamera, SwarmPhotodiodes
from benchmarks.swarm.happenings import (
    ClockStep,
    Cloud,
    FullDisk,
    Happening,
    Kill,
    Order,
    Plan,
    RecorderDeath,
    RecorderStuck,
    Sequence,
    Stall,
    Strike,
)
from benchmarks.swarm.invariants import ANSWERED_ONCE, Invariants
from benchmarks.swarm.lines import Bus, Line
from benchmarks.swarm.own_stars import turned_by
from benchmarks.swarm.recorder import SwarmRecorder
from benchmarks.swarm.service import HELD_BACK_S, SENDERS, SwarmService
from benchmarks.swarm.telemetry_wire import Publisher, RemoteConsole, Subscriber
from benchmarks.swarm.threads import VirtualExecutor, VirtualTime
from fitctl.config import Rig, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.pair import Design
from fitctl.drivers.interface import Devices, LoopDevices
from fitctl.logging.queue import RecordQueue
from fitctl.logging.records import AnyRecord, ModeChange, Place
from fitctl.messages.commands import Acquire, AnyCommand, Recover, Reply, Shutdown, Standby
from fitctl.messages.modes import Mode
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.simulation.devices import SimulatedMirror
from fitctl.stages.periodic import PeriodicThread
from fitctl.supervisor.supervisor import Supervisor

RIGS = Path(__file__).parents[2] / "rigs"
_HISTORY_S = 20.0  # a frame may come so late, after several stalls in a row
_ANSWER_S = 5.0
# When the service has ended: younger commands and answers may be under way.
_ANSWERED_AT_THE_END_S = 1.5
_WIND_DOWN_S = 1.0  # as fitctl.daemon.run
_START_S = 2.0
_SHUT_DOWN_S = 50.0  # with closing, the service's end and the last records
_CLOSING_S = 31.0  # the supervisor waits 30 s for its devices
_SEQUENCE_ENDS_S = 15.0
_MOST_DESIGN_S = 20.0
_NOISE_STEP = 1.05
_SAVED_S = 1.0  # so often a supervisor leaves where its stars are
_MISLED_S = 10.0  # after a repeated image or a wrong encoder, in which a star's place may be wrong
_LEADS_ON: dict[Mode, type[Standby | Recover | Acquire]] = {
    Mode.OFF: Standby,
    Mode.SAFE: Recover,
    Mode.STANDBY: Acquire,
}


@functools.cache
def _design_once(
    rig_file: str,
    settings: tuple[str, ...],
    name: str,
    controller: str,
    noise_px: float | None,
) -> Design:
    """Designs are the same for every seed."""
    return design_for(load_rig(RIGS / rig_file, settings), name, controller, noise_px)


def _is_of_designs(setting: str) -> bool:
    """Whether a design may depend on a setting of the rig."""
    return setting.startswith("camera.") or ".vernier." in setting or ".writes_per_frame" in setting


class Instrument:
    """The supervisor and its threads on virtual time, with devices that fail.

    Parameters
    ----------
    rig : Rig
    plan : Plan
    time : VirtualTime
        Whose threads are installed.
    subscribers : list of Subscriber
        Sockets of the consoles that are far away.
    computer : Computer
        Which is installed.
    on_record : callable, optional
        Takes every record.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Plan,
        time: VirtualTime,
        subscribers: list[Subscriber],
        computer: Computer,
        on_record: Callable[[AnyRecord], None] = lambda _: None,
    ) -> None:
        self.rig = rig
        self.time = time
        self._computer = computer
        self.plant = Plant(rig, [plan.seed], history_s=_HISTORY_S)
        self.plant.advance(self.plant.step_s)
        self.subscribers = subscribers
        self.lines: dict[str, Line] = {}
        self.resets: dict[str, Callable[[], None]] = {}
        self.modes: dict[str, int] = {}
        self._plan = plan
        self._design_random = self._random("design")
        # To take and encode them costs time; only these steps measure frames.
        self._needs_frames = any(
            isinstance(one, Sequence) and {"dark", "overlap"}.intersection(one.steps)
            for one in plan.happenings
        )
        self._designs_take_time = False
        self._on_record = on_record
        self._digest = hashlib.blake2b(digest_size=16)
        self._encode = msgspec.msgpack.Encoder().encode
        self._unanswered: dict[int, tuple[float, float, str]] = {}
        self._posted = 0
        self._places: list[Place] = []
        self._lives = 0
        self._is_healed = False
        self._recorder_stuck_until_s = 0.0
        self._sequences: list[RunningSequence] = []
        self.found_s: dict[
            str, float
        ] = {}  # by loop: its star was found, and is not to be forgotten
        self.amplifiers: dict[str, SwarmAmplifiers] = {}
        self.invariants = Invariants(rig, time, self.amplifiers, self.lines, self.plant)
        if not any(isinstance(one, Strike | Stall) for one in plan.happenings):
            self.invariants.nothing_fails = True
        self._console = Console(self.invariants, time, self._random("console"), plan.console_loss)
        for number, subscriber in enumerate(subscribers):
            name = f"remote console {number}"
            remote = RemoteConsole(self.invariants, time, self._random(name), subscriber)
            time.spawn(remote.run, name, apart=True)
        self.camera = SwarmCamera(rig, time, self.plant, self._random("camera"))
        self._add("camera", self.camera)
        loops = {name: self._loop_devices(name) for name in rig.loops}
        hexapod = None
        if rig.collector is not None:
            hexapod = self.invariants.hexapod = SwarmHexapod(
                self.plant, time, rig, self._random("hexapod"), self.invariants.motion.pose
            )
            self._add("hexapod", hexapod)
        self.devices = Devices(self.camera, loops, hexapod)
        self.start()

    def _random(self, name: str) -> Random:
        return Random(f"{self._plan.seed} {name}")  # noqa: S311 - a repeatable draw

    def _add(self, name: str, device: Any) -> None:
        self.lines[name] = device.line
        self.resets[name] = device.reset

    def _loop_devices(self, name: str) -> LoopDevices:
        part, random, time, rig = self.plant.loops[name], self._random(name), self.time, self.rig
        self.amplifiers[name] = amplifiers = SwarmAmplifiers(
            part,
            time,
            rig,
            name,
            random,
            self.invariants.motion.velocity,
            self.invariants.powered_unread,
            self.invariants.zeros.read,
        )
        self._add(f"{name} siderostat", amplifiers)
        bus = None
        if len(rig.loops) > 1:  # as fitctl.daemon.devices.can_buses
            bus = amplifiers.line.bus = Bus()
            bus.drives.append(amplifiers.synchronize)
        if isinstance(part, MetrologyPart):
            photodiodes = SwarmPhotodiodes(part, time, rig, name, random)
            self._add(f"{name} photodiodes", photodiodes)
            return LoopDevices(amplifiers, photodiodes=photodiodes, bus=bus)
        mirror = SimulatedMirror(part, time, rig, name)  # pyrefly: ignore[bad-argument-type]
        written, made_safe = self.invariants.motion.volts, self.invariants.motion.mirror_moved
        dac = SwarmDac(mirror, time, rig, name, random, written, made_safe)
        piezo = SwarmPiezo(mirror, time, rig, name, random)
        self._add(f"{name} D/A", dac)
        self._add(f"{name} piezo", piezo)
        return LoopDevices(amplifiers, dac=dac, piezo=piezo, bus=bus)

    # ------------------------------------------------------------ the supervisor's process

    def start(self) -> None:
        """Start a supervisor, with its service and its recorder."""
        self.time.new_process()
        self._unanswered.clear()
        self._lives += 1
        self._records, self._shutdown_awake_s = 0, math.inf
        size = self.rig.logging.queue_records
        self._queue = RecordQueue("swarm", size)
        self.recorder = SwarmRecorder(self.time, self._queue)
        self.recorder.stuck_until_s = self._recorder_stuck_until_s
        self.service: SwarmService | None = None
        self.supervisor = Supervisor(
            self.rig,
            self.devices,
            self.time,
            VirtualExecutor(self.time, "devices"),
            self._record,
            self._design,
            design_executor=VirtualExecutor(self.time, "design"),
            record_frames=self._needs_frames,
        )
        self.supervisor.recall(self._places)
        self._designs_take_time = True
        self.invariants.watch(self.supervisor)
        self.running = True
        queue = self._queue
        self.service = SwarmService(
            self.supervisor,
            self.time,
            self.invariants,
            self._lives,
            Publisher(self.subscribers),
            lambda: queue.lost,
            lambda: queue.offered,
        )
        self._console.connect(self.service, self.supervisor)
        self._machine = self._computer.machine_of(
            self.supervisor,
            lambda: queue.waiting / self.rig.logging.queue_records,
            self.invariants.violated,
        )
        self._threads = [PeriodicThread(work, self.time) for work in self.supervisor.periodic]
        for thread in self._threads:
            thread.start()
        self.time.spawn(self._main, "main")

    def kill(self, back_after_s: float) -> None:
        """The supervisor's process is gone, and a new one comes."""
        if self.running:
            self.account_for_records()
            self.time.kill_process()
            saved_s = self.time.now_s() - 2 * _SAVED_S
            self.found_s = {name: at_s for name, at_s in self.found_s.items() if at_s < saved_s}
            self._end(back_after_s)

    def _end(self, back_after_s: float) -> None:
        self.running = self._designs_take_time = False
        self.service = None
        self.recorder.end()
        self._unanswered.clear()
        self.invariants.watch(None)
        self.time.call_at(self.time.now_s() + back_after_s, self.start)

    def _main(self) -> None:
        """As :func:`fitctl.daemon.run.run_supervisor` does it."""
        supervisor, tick = self.supervisor, self.invariants.tick
        second_s = self.time.now_s()
        while not supervisor.shutdown_wanted:
            supervisor.step()
            tick()
            if self.time.now_s() - second_s >= 1.0:
                second_s = self.time.now_s()
                self._once_a_second()
        supervisor.stop("shutting down")
        end_s = self.time.now_s() + _WIND_DOWN_S
        while self.time.now_s() < end_s and not supervisor.at_rest():
            supervisor.step()
            tick()
        reached = {name for name, each in self.amplifiers.items() if each.line.connected}
        awake_s = self.time.awake_s()
        supervisor.close()
        closing_s = self.time.awake_s() - awake_s
        if closing_s > _CLOSING_S:
            self.invariants.violated("opening and closing end", f"closing took {closing_s:.1f} s")
        self.invariants.closed(reached)
        for thread in self._threads:
            thread.stop()
        if self.service is not None:
            self.service.stop()
        self.service = None
        self.answers_due(_ANSWERED_AT_THE_END_S)
        self._unanswered.clear()  # what arrives now finds nobody, however long the log takes
        self._finish_log()
        self.time.kill_process()
        self._places = []
        self.found_s.clear()
        self._end(_START_S)

    def _once_a_second(self) -> None:
        queue, supervisor = self._queue, self.supervisor
        queue.pump()
        self._places = supervisor.places
        self._machine.look()
        self.recorder.disk_is_full = self._computer.disk_is_full

    def _finish_log(self) -> None:
        self.account_for_records()
        unreported = self.recorder.finish()
        if unreported:
            self.invariants.violated("a record is written or counted", unreported)

    def account_for_records(self) -> None:
        """Every record is written, or waits, or was counted."""
        wrong = self.recorder.unaccounted(self._records)
        if wrong:
            self.invariants.violated("a record is written or counted", wrong)

    @property
    def records_offered(self) -> int:
        """How many records the supervisor has made."""
        return self._queue.offered

    def records_written(self, offered: int, waited_s: float) -> None:
        """The recorder has written the first so many records, except those that were lost."""
        waiting = self.recorder.waits_since(offered)
        if waiting:
            self.invariants.violated(
                "a record is written or counted", f"{waiting} wait for {waited_s:g} s or longer"
            )

    def _design(
        self, _rig: Rig, name: str, controller: str, noise_px: float | None = None, /
    ) -> Design:
        if self._designs_take_time:  # those of the start come before time goes on
            self.time.sleep(self._design_random.uniform(0.5, _MOST_DESIGN_S))
        plan = self._plan
        of_designs = tuple(text for text in plan.settings if _is_of_designs(text))
        if noise_px is not None:  # so many clouds would have too many designs made
            noise_px = _NOISE_STEP ** round(math.log(noise_px, _NOISE_STEP))
        return _design_once(plan.rig, of_designs, name, controller, noise_px)

    def _record(self, record: AnyRecord) -> None:
        self._digest.update(self._encode(record))
        self._records += 1
        self._queue.offer(record)
        if self.service is not None:
            self.service.take(record)
        self.invariants.record(record)
        if isinstance(record, ModeChange):
            self.modes[record.target] = self.modes.get(record.target, 0) + 1
            if record.target == Mode.COARSE.name and record.loop in self.rig.stellar_loops:
                turning = [self.amplifiers[name] for name in turned_by(self.rig, record.loop)]
                if not any(each.line.was_wrong("encoder", _MISLED_S) for each in turning):
                    self.found_s.setdefault(record.loop, record.time_s)
        if self.found_s and self.camera.line.was_wrong("frozen", _MISLED_S):
            self.found_s.clear()  # a repeated image has a star where none is: its place may be wrong
        self._on_record(record)

    # ------------------------------------------------------------ operators

    def give(self, who: str, command: AnyCommand) -> None:
        """An operator gives a command, by the service's rules."""
        if not self.running:
            return
        service = self.service
        if service is None:
            return
        if isinstance(command, Acquire) and command.expected_az_sky_arcsec is not None:
            for name in self.rig.loops:
                if command.loop in {"", name}:
                    self.found_s.pop(name, None)  # the star is expected elsewhere from now on
        self._posted += 1
        number = self._posted
        network_s = 0.0 if SENDERS[who].is_local else 2 * HELD_BACK_S[1]
        since = self.time.now_s(), self.time.awake_s() + network_s, type(command).__name__
        self._unanswered[number] = since
        answered = partial(self._answered, self._lives, number, command)
        service.send(SENDERS[who], command, answered)

    def _answered(self, life: int, number: int, command: AnyCommand, reply: Reply) -> None:
        if life != self._lives or self.service is None:
            return  # it was on its way when the service ended
        if self._unanswered.pop(number, None) is None:
            name = type(command).__name__
            self.invariants.violated(ANSWERED_ONCE, f"{name} {number}: twice")
        if isinstance(command, Shutdown) and reply.accepted:
            self._shutdown_awake_s = min(self._shutdown_awake_s, self.time.awake_s())

    def lead_on(self, who: str, *, from_zero: bool = False) -> None:
        """Give the command that leads every loop on towards its star; `from_zero`, sought about there."""
        for name, loop in self.supervisor.loops.items() if self.running else ():
            make = _LEADS_ON.get(loop.mode)
            if make is Acquire and from_zero and name not in self.found_s:
                self.give(who, self._acquire_where_it_is(name))
            elif make is not None:
                self.give(who, make(loop=name))

    def _acquire_where_it_is(self, name: str) -> Acquire:
        """About where the encoders read zero at the start, before they lost it.

        A star is expected on the other side of where the siderostat goes for it.
        """
        az_arcsec, el_arcsec = (
            zero_rad * self.rig.loops[name].siderostat.sky_arcsec_per_motor_rad
            for zero_rad in self.amplifiers[name].zero_rad
        )
        return Acquire(
            loop=name, expected_az_sky_arcsec=az_arcsec, expected_el_sky_arcsec=el_arcsec
        )

    def answers_due(self, within_s: float = _ANSWER_S) -> None:
        """No command waits longer for its answer than a step may take; a stalled machine does not count."""
        now_s = self.time.awake_s()
        for since_s, awake_s, name in self._unanswered.values():
            if now_s - awake_s > within_s:
                self.invariants.violated(ANSWERED_ONCE, f"{name} of {since_s:.3f} s never was")
        if self.running and now_s - self._shutdown_awake_s > _SHUT_DOWN_S:
            self.invariants.violated("a shutdown ends the supervisor", f"not in {_SHUT_DOWN_S:g} s")

    # ------------------------------------------------------------ what happens

    def happen(self, happening: Happening) -> None:
        """Let something happen, unless all is being healed."""
        if self._is_healed:
            return
        match happening:
            case Order(command=None):
                self.lead_on(happening.who)
            case Order(command=command) if command is not None:
                self.give(happening.who, command)
            case Stall():
                self.invariants.stalled(*self.time.stall(happening.lasts_s, alone=happening.alone))
            case Kill():
                self.kill(happening.back_after_s)
            case RecorderDeath():
                self.recorder.die()
            case RecorderStuck():
                until_s = self.time.now_s() + happening.lasts_s
                self._recorder_stuck_until_s = max(self._recorder_stuck_until_s, until_s)
                self.recorder.stuck_until_s = self._recorder_stuck_until_s
            case FullDisk():
                self._computer.disk_is_full = True
                self.time.call_at(self.time.now_s() + happening.lasts_s, self._empty_disk)
            case ClockStep():
                self._computer.wall_s += happening.by_s
            case Sequence():
                self._start_sequence(happening)
            case Cloud():
                self._dim(happening.part)
                self.time.call_at(self.time.now_s() + happening.lasts_s, partial(self._dim, 1.0))
            case Strike(device=device):
                self._strike(happening, device.removesuffix(" siderostat"))

    def _strike(self, strike: Strike, loop_name: str) -> None:
        """Let a fault begin; one with a duration ends after it. `loop_name` is that of a siderostat."""
        self.invariants.struck(strike.device)
        match strike.fault:
            case "reset":
                self.resets[strike.device]()
            case "power cut":
                self._cut_power(loop_name)
            case "trip":
                self.amplifiers[loop_name].trip()
            case fault:
                line = self.lines[strike.device]
                line.begin(fault, strike.lasts_s, strike.size, strike.part, strike.number)
                if fault == "encoder":
                    self.invariants.zeros.encoder_wrong(loop_name)
                    self._forget_places(loop_name)

    def _cut_power(self, name: str) -> None:
        """Restart a loop's encoders at zero; the places of the stars that it turns are unknown from then on.

        If the star would then be beyond the siderostat's travel, which takes a person to mend, the encoders
        keep their zero.
        """
        settings = self.rig.loops[name]
        motor_rad = self.plant.loops[name].state.motor_rad[0]
        reach_arcsec = (
            float(np.abs(motor_rad).max()) * settings.siderostat.sky_arcsec_per_motor_rad
            + settings.acquisition.search_radius_sky_arcsec
        )
        if reach_arcsec > settings.siderostat.travel_sky_arcsec:
            self.amplifiers[name].reset()
            return
        self.invariants.zeros.lost(name)
        self.amplifiers[name].lose_power()
        self._forget_places(name)

    def _forget_places(self, name: str) -> None:
        """The places of the stars that a loop's siderostat turns are not to be relied on."""
        for star in self.rig.stellar_loops:
            if name in turned_by(self.rig, star):
                self.found_s.pop(star, None)

    def _empty_disk(self) -> None:
        self._computer.disk_is_full = False

    def _start_sequence(self, happening: Sequence) -> None:
        violated = self.invariants.violated
        link = Link(self.time, lambda: self.service, SENDERS[happening.who], violated)
        sequence = RunningSequence(link, self.rig, happening.loop, happening.steps)
        self._sequences.append(sequence)
        self.time.spawn(sequence.run, f"sequence at {happening.at_s:.3f} s", apart=True)

    def end_sequences(self) -> None:
        """Somebody stops every sequence, and each ends soon."""
        for sequence in self._sequences:
            sequence.stop()
        self.time.run_until(self.time.now_s() + _SEQUENCE_ENDS_S)
        if not all(sequence.ended for sequence in self._sequences):
            self.invariants.violated("a sequence that is stopped ends", "one did not")

    def _dim(self, part: float) -> None:
        self.camera.dim(part)
        for beam in self.plant.metrology_loops.values():
            beam.state.laser[:] = part

    def heal(self) -> None:
        """End every fault, and let none begin."""
        self._is_healed = True
        self._dim(1.0)
        self._empty_disk()
        for line in self.lines.values():
            line.heal()

    @property
    def digest(self) -> str:
        """Of all records until now."""
        return self._digest.hexdigest()
