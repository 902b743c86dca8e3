"""One stellar loop's tick, from a frame to a command.

frame -> centroid (or star finder) -> interlocks -> mode's control law -> saturate on the mirror's
diamond -> D/A write and siderostat set-point -> record.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.centroid import Star
from fitctl.controllers.pair import Design
from fitctl.drivers.interface import DeviceError, Frame, MirrorDac
from fitctl.logging.records import (
    AnyRecord,
    ControllerChange,
    Event,
    FailingDevice,
    ModeChange,
    Severity,
    Tick,
)
from fitctl.loop.experiments import Experiments
from fitctl.loop.following import Following
from fitctl.loop.interlocks import Interlocks
from fitctl.loop.observation import Observation
from fitctl.loop.pointing import Pointing
from fitctl.loop.quantities import Quantities, places
from fitctl.loop.search import Search
from fitctl.loop.star_finder import StarFinder
from fitctl.loop.tick_record import TickRecords, TickTimes
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import (
    FOLLOWING,
    TRACKING,
    Finding,
    Mode,
    Trigger,
    transition,
)
from fitctl.model.drives import Drive
from fitctl.model.optics import scales
from fitctl.stages.failures import failure_record
from fitctl.stages.servo import ServoState, SiderostatServo
from fitctl.stages.stages import Stages

Floats = NDArray[np.float64]
_SEVERITY: dict[Trigger, Severity] = {
    Trigger.FAULT: "error",
    Trigger.STAR_LOST: "warning",
    Trigger.SEARCH_EXHAUSTED: "warning",
}


class StellarLoop:
    """One stellar loop: its mode, its controllers and its stages.

    Parameters
    ----------
    name : str
    rig : Rig
    servo : SiderostatServo
    dac : MirrorDac
    clock : Clock
    report : callable
        Takes every record that the loop makes; must not block.
    """

    def __init__(
        self,
        name: str,
        rig: Rig,
        servo: SiderostatServo,
        dac: MirrorDac,
        clock: Clock,
        report: Callable[[AnyRecord], None],
    ) -> None:
        loop = rig.loops[name]
        self.name = name
        self.settings = loop
        self.servo = servo
        self.mode = Mode.OFF
        self.mode_since_s = clock.now_s()
        self.last_change: ModeChange | None = None
        self._last_failure = ""
        self.target_px = np.array([loop.target_px.az, loop.target_px.el])
        self._clock = clock
        self._report = report
        scale = scales(rig, loop)
        self._period_s = rig.camera.period_s
        self.star_finder = StarFinder(rig, name, self.target_px, self._report_event)
        self.search = Search(rig, name, self.star_finder.estimator)
        self.following = Following(loop, scale)
        self.pointing = Pointing(rig, name, self.target_px)
        self.stages = Stages(rig, name, servo, dac, clock)
        self._experiments = Experiments(name, scale.motor_px_per_rad, report)
        self._tick_records = TickRecords(rig, name)
        self._flattened = False
        self.quantities = Quantities(rig, name)
        self.interlocks = Interlocks(rig.interlocks, places(rig, name))
        self._laws: dict[Mode, Callable[[Observation], None]] = {
            Mode.OFF: self._rest,
            Mode.STANDBY: self._stand_by,
            Mode.ACQUISITION: self._search,
            Mode.COARSE: self._pull_in,
            Mode.VERNIER: self._hold_star,
            Mode.EXPERIMENT: self._run_experiment,
            Mode.SAFE: self._rest,
        }

    # ------------------------------------------------------------ the tick

    def tick(self, frame: Frame | None, frames_lost: int) -> Tick:
        """One tick, with the newest frame or without one."""
        servo = self.servo.read_state()
        started_s = self._clock.now_s()
        self._experiments.record_injections(self.stages)
        observation = self._sense(frame, servo, started_s)
        sensed_s = self._clock.now_s()
        self._evaluate_findings(frame, observation)
        self._evaluate_interlocks(frame, observation)
        self._move(frame, observation)
        decided_s = self._clock.now_s()
        self._write()
        times = TickTimes(sensed_s, decided_s, self._clock.now_s())
        tick = self._tick_records.make(
            self.mode,
            frame,
            frames_lost,
            observation,
            self.stages,
            self.pointing,
            self.search,
            times,
        )
        self.quantities.record_tick(tick.compute_s, tick.time_s)
        return tick

    def _move(self, frame: Frame | None, observation: Observation) -> None:
        """By the mode's law, unless an interlock holds or flattens."""
        action = self.interlocks.action if self.mode in TRACKING else None
        if action == "flatten":
            self.stages.mirror_to_bias()
        elif self._flattened and self.mode is Mode.VERNIER:
            self.pointing.start_pair(self.stages, observation.motor_rad)
        self._flattened = action == "flatten"
        # Without a frame to track by, the stages wait where they are.
        waits = frame is None and self.mode in TRACKING
        if action not in {"hold", "flatten"} and not waits:
            self._laws[self.mode](observation)

    def _sense(self, frame: Frame | None, servo: ServoState, now_s: float) -> Observation:
        """What a frame shows belongs to where the stages were when it was exposed."""
        if frame is None:
            return Observation(None, self.stages.mirror_now_rad, servo.position_rad, servo, now_s)
        motor_rad = self.servo.position_at(frame.mid_exposure_s)
        mirror_rad = self.stages.mirror_at(frame.mid_exposure_s)
        star = self._find(frame, mirror_rad, motor_rad)
        return Observation(star, mirror_rad, motor_rad, servo, now_s)

    def _find(self, frame: Frame, mirror_rad: Floats, motor_rad: Floats) -> Star | None:
        if self.mode is Mode.ACQUISITION and not self.search.has_arrived(motor_rad):
            return None  # what is seen on the way is another star
        follows = self.mode in FOLLOWING and self.following.lost == 0
        return self.star_finder.find(frame.image, self.mode, motor_rad, mirror_rad, follows=follows)

    def _evaluate_findings(self, frame: Frame | None, observation: Observation) -> None:
        """Errors of devices and findings: what leads to another mode."""
        if observation.servo.fault is not None:
            self.device_failed("siderostat", observation.servo.fault)
        elif self.mode is Mode.EXPERIMENT and self.stages.injector.fault is not None:
            self.stages.ready = False
            self.device_failed("injector", self.stages.injector.fault)
        elif (
            frame is not None and (found := self._find_trigger(frame, observation.star)) is not None
        ):
            if found.trigger is None:
                self._report_event("warning", found.reason)
            else:
                self.fire(found.trigger, found.reason)

    def _find_trigger(self, frame: Frame, star: Star | None) -> Finding | None:
        if self.mode is Mode.ACQUISITION:
            return self.search.evaluate(star, frame.mid_exposure_s)
        if self.mode in FOLLOWING:
            return self.following.evaluate(self.mode, star, self.pointing.command_px)
        return None

    def _evaluate_interlocks(self, frame: Frame | None, observation: Observation) -> None:
        """Measure, judge by the rig file's table, and tell; what holds or flattens, :meth:`_move` asks for."""
        now_s, measured, interlocks = observation.now_s, self.quantities, self.interlocks
        if frame is not None:
            measured.record_frame(frame, observation.star, now_s)
        measured.record_stages(observation.servo, self.stages, now_s)
        for trip, over in interlocks.evaluate(self.mode.name, now_s, measured.readings):
            if over:
                self._report_event("info", f"interlock {trip.name} is over")
            elif trip.action == "safe":
                self.fail(trip.reason)
            else:
                self._report_event("warning", f"{trip.reason} ({trip.action})")
        if interlocks.tripped:
            self._enforce_interlocks()

    def _enforce_interlocks(self) -> None:
        """What is tripped stays in force, whatever mode the loop is put in."""
        action = self.interlocks.action
        reason = next(trip.reason for trip in self.interlocks.tripped if trip.action == action)
        if action == "safe" and self.mode is not Mode.SAFE:
            self.fire(Trigger.FAULT, reason)
        elif action in {"hold", "flatten"} and self.mode is Mode.EXPERIMENT:
            self.fire(Trigger.EXPERIMENT_DONE, reason)

    def reset_interlock(self, name: str) -> str:
        """Let one go by hand; why not, if it cannot be."""
        now_s = self._clock.now_s()
        why_not = self.interlocks.reset(name, now_s, self.quantities.readings)
        if not why_not:
            self._report_event("info", f"interlock {name} is reset by hand")
        return why_not

    # ------------------------------------------------------------ modes

    def fire(self, trigger: Trigger, reason: str) -> bool:
        """Go where the table says; False where the trigger means nothing in this mode."""
        row = transition(self.mode, trigger)
        if row is None:
            return False
        now_s, motor_rad = self._clock.now_s(), self.servo.position_rad
        source, self.mode = self.mode, row.target
        if source is not self.mode:
            self.mode_since_s = now_s
        self.following.begin()
        self._enter(source, motor_rad)
        motor_az_rad, motor_el_rad = motor_rad.tolist()
        self.last_change = ModeChange(
            time_s=now_s,
            loop=self.name,
            source=source.name,
            target=row.target.name,
            target_number=int(row.target),
            trigger=trigger.name,
            reason=reason,
            siderostat_az_rad=motor_az_rad,
            siderostat_el_rad=motor_el_rad,
        )
        self._report(self.last_change)
        self._report_event(
            _SEVERITY.get(trigger, "info"), f"{source.name} -> {row.target.name}: {reason}"
        )
        return True

    def fail(self, reason: str) -> None:
        """Something is wrong: SAFE, or, where that changes nothing, an event; the same is told once."""
        if not self.fire(Trigger.FAULT, reason) and reason != self._last_failure:
            self._report_event("error", reason)
        self._last_failure = reason

    def device_failed(self, device: FailingDevice, error: Exception) -> None:
        """A device failed while it was used."""
        if str(error) != self._last_failure:
            now_s = self._clock.now_s()
            self._report(failure_record(now_s, self.name, device, error))
        self.fail(str(error))

    def _enter(self, source: Mode, motor_rad: Floats) -> None:
        if source is Mode.EXPERIMENT:
            self._end_experiment()
        if self.mode is Mode.SAFE:
            self.servo.stop()
        elif self.mode is Mode.STANDBY:
            self.servo.hold(motor_rad)
            self.stages.keep_siderostat()
        elif self.mode is Mode.ACQUISITION:
            self._start_search(motor_rad)
        elif self.mode is Mode.COARSE:
            self.pointing.start_coarse(self.target_px)
        elif self.mode is Mode.VERNIER:
            self.pointing.start_pair(self.stages, motor_rad)

    def configure_search(self, asked: Acquire) -> None:
        """What the next search is to find, and how, as a command asks that was not refused."""
        flux_dn = asked.star_flux_dn or self.settings.star_flux_dn
        self.star_finder.expect_flux(flux_dn)
        self.quantities.star_flux_dn = flux_dn
        self.search.configure(asked)

    def _start_search(self, motor_rad: Floats) -> None:
        """As asked; else about where the star is expected: on the target, or where it was last seen."""
        self.star_finder.estimator.expect(self.target_px, motor_rad, np.zeros(2))
        self.search.begin()

    # ------------------------------------------------------------ control laws

    def _rest(self, _observation: Observation) -> None:
        """Mirror back to its bias; the siderostat is held or stopped by its servo."""
        self.stages.mirror_to_bias()

    def _stand_by(self, _observation: Observation) -> None:
        """Both stages rest where the operator has put them."""
        self.stages.mirror_to_rest()

    def _search(self, observation: Observation) -> None:
        self.stages.mirror_to_rest()
        self.stages.siderostat_to(self.search.advance(self._period_s, observation.motor_rad))

    def _pull_in(self, observation: Observation) -> None:
        self.stages.mirror_to_rest()
        step_rad = self.pointing.step_coarse(observation, self.target_px)
        if step_rad is not None:
            self._siderostat_by(step_rad)

    def _hold_star(self, observation: Observation) -> None:
        command = self.pointing.step_pair(observation, self.target_px)
        if command is not None:
            self._siderostat_by(command.motor_step_rad)
            self.stages.mirror_to(
                command.mirror_rad, hysteresis_inverse=self.pointing.design.hysteresis_inverse
            )

    def _run_experiment(self, observation: Observation) -> None:
        setpoint_rad = self._experiments.setpoint_rad(observation.now_s)
        if setpoint_rad is None:
            self.fire(Trigger.EXPERIMENT_DONE, "all motions done")
        else:
            self.stages.siderostat_to(setpoint_rad)

    def _siderostat_by(self, step_rad: Floats) -> None:
        self.stages.siderostat_to(self.stages.setpoint_rad + step_rad)

    # ------------------------------------------------------------ designs and experiments

    @property
    def controller(self) -> str:
        """The design at work in VERNIER."""
        return self.pointing.design.name

    def use(self, design: Design) -> None:
        """Work with another design from the next tick on; in VERNIER the mirror goes on where it is."""
        before, motor_rad = self.controller, self.servo.position_rad
        self.pointing.use(design)
        if self.mode is Mode.VERNIER:
            self.pointing.start_pair(self.stages, motor_rad)
        az_rad, el_rad = motor_rad.tolist()
        self._report(
            ControllerChange(
                time_s=self._clock.now_s(),
                loop=self.name,
                source=before,
                target=design.name,
                siderostat_az_rad=az_rad,
                siderostat_el_rad=el_rad,
            )
        )
        self._report_event("info", f"controller {before} -> {design.name}")

    def start_experiment(self, name: str, drives: list[Drive]) -> bool:
        """Move the stages as told, from the next tick on; False where this mode has no star to watch."""
        now_s = self._clock.now_s()
        if not self.fire(Trigger.EXPERIMENT, name):
            return False
        self._experiments.begin(name, drives, self.stages, now_s)
        return True

    def _end_experiment(self) -> None:
        held_rad = self._experiments.end(self.stages)
        if held_rad is not None and self.mode is not Mode.SAFE:
            self.stages.siderostat_to(held_rad)

    # ------------------------------------------------------------ stages

    def start_from(self, stack_v: Floats) -> None:
        """Begin anew with devices just opened and checked.

        The D/A's outputs, shape (3,), are taken as found: the mirror goes to its bias from there. Every
        interlock is judged anew.
        """
        self.stages.start_from(stack_v)
        self._last_failure = ""
        self.quantities.begin()
        self.interlocks.reset_all(self._clock.now_s())
        if self.servo.encoders_jumped:
            self.star_finder.estimator.forget()
            self._report_event(
                "warning", "encoders read elsewhere than before; the star's place is forgotten"
            )

    def _write(self) -> None:
        """Every tick, so that the D/A's watchdog sees that we live."""
        if not self.stages.ready or self.mode in {Mode.OFF, Mode.EXPERIMENT}:
            return
        try:
            self.stages.write()
        except DeviceError as error:
            self.device_failed("D/A", error)

    def _report_event(self, severity: Severity, message: str) -> None:
        self._report(
            Event(
                time_s=self._clock.now_s(),
                severity=severity,
                source=self.name,
                message=message,
            )
        )
