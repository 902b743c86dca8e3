"""One stellar loop's tick, from a frame to a command.

frame -> centroid (or star finder) -> interlocks -> mode's control law -> saturate on the mirror's
diamond -> D/A write and siderostat set-point -> record.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import HALF_WINDOW_PX, Rig
from fitctl.controllers.centroid import Star, StarSensor
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.estimator import StarEstimator
from fitctl.controllers.pair import Design, Measurement, Pair
from fitctl.controllers.prefilter import Prefilter
from fitctl.drivers.interface import DeviceError, Frame, MirrorDac, ServoReading
from fitctl.logging.records import (
    AnyRecord,
    ControllerChange,
    Event,
    ExperimentStart,
    FailingDevice,
    InjectionRecord,
    ModeChange,
    Severity,
    Tick,
)
from fitctl.model.drives import SIDEROSTAT, Drive, channel_values, experiment_s
from fitctl.model.optics import scales
from fitctl.supervisor.interlocks import Interlocks
from fitctl.supervisor.messages import Acquire
from fitctl.supervisor.modes import FOLLOWING, TRACKING, Mode, Trigger, transition
from fitctl.supervisor.power import failure_record
from fitctl.supervisor.quantities import Quantities, places
from fitctl.supervisor.search import Search
from fitctl.supervisor.servo import ServoState, SiderostatServo
from fitctl.supervisor.stages import Stages

Floats = NDArray[np.float64]
_NO_READING = ServoReading(math.nan, (math.nan, math.nan), enabled=False, fault="")
_SEVERITY: dict[Trigger, Severity] = {
    Trigger.FAULT: "error",
    Trigger.STAR_LOST: "warning",
    Trigger.SEARCH_EXHAUSTED: "warning",
}


@dataclass
class Findings:
    """Consecutive ticks on which something held; they lead to transitions."""

    lost: int = 0
    in_reach: int = 0
    out_of_reach: int = 0


@dataclass(frozen=True)
class Experiment:
    """Test motions under way, about where the siderostat was held."""

    drives: list[Drive]
    start_s: float
    end_s: float
    held_rad: Floats


class Seen(NamedTuple):
    """What a tick goes by.

    A frame's star, if any; where the stages were at its mid-exposure, each shape (2,); how the servo is now,
    and when that is.
    """

    star: Star | None
    mirror_rad: Floats
    motor_rad: Floats
    servo: ServoState
    now_s: float


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
        self._scale = scales(rig, loop)
        self._period_s = rig.camera.period_s
        self._due_after_s = rig.camera.frame_delay_s + rig.supervisor.late_tick_s
        self._sensor = StarSensor(rig.camera, loop)
        self._estimator = StarEstimator(self._scale, self.target_px)
        self.search = Search(rig, name, self._estimator)
        self._prefilter = Prefilter(loop.prefilter.time_constant_s, self._period_s, self.target_px)
        self._coarse_step_rad_per_px = (
            loop.coarse.gain_rad_per_m * self._scale.pixel_size_m * self._period_s
        )
        self._pair = self._pair_of(design_for(rig, name))
        self.stages = Stages(rig, name, servo, dac, clock)
        self._experiment: Experiment | None = None
        self._range_px = self._scale.mirror_px_per_rad * loop.fsm.range_rad
        self._findings = Findings()
        self._flattened = False
        self.measured = Quantities(rig, name)
        self.interlocks = Interlocks(rig.interlocks, places(rig, name))
        self._laws: dict[Mode, Callable[[Seen], None]] = {
            Mode.OFF: self._rest,
            Mode.STANDBY: self._stand_by,
            Mode.ACQUISITION: self._search,
            Mode.COARSE: self._pull_in,
            Mode.VERNIER: self._hold_star,
            Mode.EXPERIMENT: self._move_as_told,
            Mode.SAFE: self._rest,
        }

    # ------------------------------------------------------------ the tick

    def tick(self, frame: Frame | None, frames_lost: int) -> Tick:
        """One tick, with the newest frame or without one."""
        servo = self.servo.look()
        started_s = self._clock.now_s()
        self._note_injections()
        seen = self._sense(frame, servo, started_s)
        sensed_s = self._clock.now_s()
        self._judge(frame, seen)
        self._judge_interlocks(frame, seen)
        self._move(frame, seen)
        decided_s = self._clock.now_s()
        self._write()
        tick = self._record(frame, seen, frames_lost, (sensed_s, decided_s))
        self.measured.of_tick(tick.compute_s, tick.time_s)
        return tick

    def _move(self, frame: Frame | None, seen: Seen) -> None:
        """By the mode's law, unless an interlock holds or flattens."""
        action = self.interlocks.action if self.mode in TRACKING else None
        if action == "flatten":
            self.stages.mirror_to_bias()
        elif self._flattened and self.mode is Mode.VERNIER:
            self._start_pair(seen.motor_rad)
        self._flattened = action == "flatten"
        # Without a frame to track by, the stages wait where they are.
        waits = frame is None and self.mode in TRACKING
        if action not in {"hold", "flatten"} and not waits:
            self._laws[self.mode](seen)

    def _sense(self, frame: Frame | None, servo: ServoState, now_s: float) -> Seen:
        """What a frame shows belongs to where the stages were when it was exposed."""
        if frame is None:
            return Seen(None, self.stages.mirror_now_rad, servo.position_rad, servo, now_s)
        motor_rad = self.servo.position_at(frame.mid_exposure_s)
        mirror_rad = self.stages.mirror_at(frame.mid_exposure_s)
        star = self._find(frame, mirror_rad, motor_rad)
        return Seen(star, mirror_rad, motor_rad, servo, now_s)

    def _find(self, frame: Frame, mirror_rad: Floats, motor_rad: Floats) -> Star | None:
        if self.mode is Mode.ACQUISITION and not self.search.is_there(motor_rad):
            return None  # what is seen on the way is another star
        if self.mode in FOLLOWING and self._findings.lost == 0:
            predicted = self._estimator.predict_px(motor_rad, mirror_rad)
            star = self._sensor.measure(frame.image, *predicted.tolist())
            # The estimate may be half a window off after a jump; then the whole frame decides.
            if star is None or self._near_edge(star):
                star = self._sensor.find(frame.image)
        else:
            star = self._sensor.find(frame.image)
        if star is not None and self.mode in TRACKING:
            self._estimator.observe(_position(star), motor_rad, mirror_rad)
        return star

    def _judge(self, frame: Frame | None, seen: Seen) -> None:
        """Errors of devices and findings: what leads to another mode."""
        if seen.servo.fault is not None:
            self.device_failed("siderostat", seen.servo.fault)
        elif frame is not None and self.mode is Mode.ACQUISITION:
            self._judge_search(frame, seen.star)
        elif self.mode is Mode.EXPERIMENT and self.stages.injector.fault is not None:
            self.stages.ready = False
            self.device_failed("injector", self.stages.injector.fault)
        elif frame is not None and self.mode in FOLLOWING:
            self._judge_tracking(seen.star)

    def _judge_interlocks(self, frame: Frame | None, seen: Seen) -> None:
        """Measure, judge by the rig file's table, and tell; what holds or flattens, :meth:`_move` asks for."""
        now_s, measured, interlocks = seen.now_s, self.measured, self.interlocks
        if frame is not None:
            measured.of_frame(frame, seen.star, now_s)
        measured.of_stages(seen.servo, self.stages, now_s)
        for trip, over in interlocks.judge(self.mode.name, now_s, measured.readings):
            if over:
                self._event("info", f"interlock {trip.name} is over")
            elif trip.action == "safe":
                self.fail(trip.reason)
            else:
                self._event("warning", f"{trip.reason} ({trip.action})")
        if interlocks.tripped:
            self._obey_interlocks()

    def _obey_interlocks(self) -> None:
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
        why_not = self.interlocks.reset(name, now_s, self.measured.readings)
        if not why_not:
            self._event("info", f"interlock {name} is reset by hand")
        return why_not

    def _judge_search(self, frame: Frame, star: Star | None) -> None:
        found = self.search.judge(star, frame.mid_exposure_s)
        if found is None:
            return
        if found.trigger is None:
            self._event("warning", found.reason)
        else:
            self.fire(found.trigger, found.reason)

    def _judge_tracking(self, star: Star | None) -> None:
        findings, acquisition = self._findings, self.settings.acquisition
        if star is None:
            findings.lost += 1
            findings.in_reach = findings.out_of_reach = 0
            if findings.lost >= acquisition.lost_frames:
                self.fire(Trigger.STAR_LOST, f"no star on {findings.lost} frames in a row")
            return
        findings.lost = 0
        error_px = _position(star) - self._prefilter.value_px
        # The mirror's diamond lies along its own axes.
        need = float(np.abs(error_px.dot(self._scale.mirror_turn)).sum()) / self._range_px
        frames = self.settings.coarse.reach_frames
        in_reach = need <= self.settings.coarse.reach_fraction
        findings.in_reach = findings.in_reach + 1 if in_reach else 0
        findings.out_of_reach = findings.out_of_reach + 1 if need > 1.0 else 0
        if self.mode is Mode.COARSE and findings.in_reach >= frames:
            self.fire(Trigger.IN_REACH, f"error needs {need:.0%} of the mirror's range")
        elif self.mode is Mode.VERNIER and findings.out_of_reach >= frames:
            self.fire(Trigger.OUT_OF_REACH, f"error needs {need:.0%} of the mirror's range")

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
        self._findings = Findings()
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
        self._event(_SEVERITY.get(trigger, "info"), f"{source.name} -> {row.target.name}: {reason}")
        return True

    def fail(self, reason: str) -> None:
        """Something is wrong: SAFE, or, where that changes nothing, an event; the same is told once."""
        if not self.fire(Trigger.FAULT, reason) and reason != self._last_failure:
            self._event("error", reason)
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
            self.stages.siderostat_held()
        elif self.mode is Mode.ACQUISITION:
            self._start_search(motor_rad)
        elif self.mode is Mode.COARSE:
            self._prefilter.reset(self.target_px)
        elif self.mode is Mode.VERNIER:
            self._start_pair(motor_rad)

    def look_for(self, asked: Acquire) -> None:
        """What the next search is to find, and how, as a command asks that was not refused."""
        flux_dn = asked.star_flux_dn or self.settings.star_flux_dn
        self._sensor.expect(flux_dn)
        self.measured.star_flux_dn = flux_dn
        self.search.ask(asked)

    def _start_search(self, motor_rad: Floats) -> None:
        """As asked; else about where the star is expected: on the target, or where it was last seen."""
        self._estimator.expect(self.target_px, motor_rad, np.zeros(2))
        self.search.begin()

    # ------------------------------------------------------------ control laws

    def _rest(self, _seen: Seen) -> None:
        """Mirror back to its bias; the siderostat is held or stopped by its servo."""
        self.stages.mirror_to_bias()

    def _stand_by(self, _seen: Seen) -> None:
        """Both stages rest where the operator has put them."""
        self.stages.mirror_to_rest()

    def _search(self, seen: Seen) -> None:
        self.stages.mirror_to_rest()
        self.stages.siderostat_to(self.search.advance(self._period_s, seen.motor_rad))

    def _pull_in(self, seen: Seen) -> None:
        self.stages.mirror_to_rest()
        command_px = self._prefilter.step(self.target_px)
        if seen.star is not None:
            error_px = _position(seen.star) - command_px
            along_px = error_px.dot(self._scale.siderostat_turn)
            self._siderostat_by(-self._coarse_step_rad_per_px * along_px)

    def _hold_star(self, seen: Seen) -> None:
        command_px = self._prefilter.step(self.target_px)
        if seen.star is None:
            return
        command = self._pair.step(
            Measurement(
                _position(seen.star) - command_px, command_px, seen.mirror_rad, seen.motor_rad
            )
        )
        self._siderostat_by(command.motor_step_rad)
        self.stages.mirror_to(
            command.mirror_rad, hysteresis_inverse=self._pair.design.hysteresis_inverse
        )

    def _move_as_told(self, seen: Seen) -> None:
        experiment, now_s = self._experiment, seen.now_s
        assert experiment is not None  # noqa: S101  # the mode is entered with one
        if now_s >= experiment.end_s:
            self.fire(Trigger.EXPERIMENT_DONE, "all motions done")
            return
        offset_px = channel_values(experiment.drives, SIDEROSTAT, now_s - experiment.start_s)
        self.stages.siderostat_to(experiment.held_rad + offset_px / self._scale.motor_px_per_rad)

    # ------------------------------------------------------------ designs and experiments

    @property
    def controller(self) -> str:
        """The design at work in VERNIER."""
        return self._pair.design.name

    def use(self, design: Design) -> None:
        """Work with another design from the next tick on; in VERNIER the mirror goes on where it is."""
        before, motor_rad = self.controller, self.servo.position_rad
        self._pair = self._pair_of(design)
        if self.mode is Mode.VERNIER:
            self._start_pair(motor_rad)
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
        self._event("info", f"controller {before} -> {design.name}")

    def start_experiment(self, name: str, drives: list[Drive]) -> bool:
        """Move the stages as told, from the next tick on; False where this mode has no star to watch."""
        now_s = self._clock.now_s()
        self._experiment = Experiment(
            drives, now_s, now_s + experiment_s(drives), self.stages.setpoint_rad.copy()
        )
        if not self.fire(Trigger.EXPERIMENT, name):
            return False
        text = msgspec.json.encode(drives).decode()
        self._report(ExperimentStart(time_s=now_s, loop=self.name, name=name, drives_json=text))
        self._report_injection(now_s, self.stages.stack_v)
        self.stages.injector.start(drives, now_s)
        return True

    def _end_experiment(self) -> None:
        self.stages.injector.end()
        self._note_injections()
        experiment, self._experiment = self._experiment, None
        if experiment is not None and self.mode is not Mode.SAFE:
            self.stages.siderostat_to(experiment.held_rad)

    def _note_injections(self) -> None:
        for time_s, stack_v in self.stages.take_injections():
            self._report_injection(time_s, stack_v)

    def _report_injection(self, time_s: float, stack_v: Floats) -> None:
        v1, v2, v3 = stack_v.tolist()
        self._report(
            InjectionRecord(time_s=time_s, loop=self.name, stack1_v=v1, stack2_v=v2, stack3_v=v3)
        )

    def _pair_of(self, design: Design) -> Pair:
        return Pair(design, self._scale, self.settings.fsm.range_rad)

    def _start_pair(self, motor_rad: Floats) -> None:
        held_rad = self.stages.mirror_held_rad(
            hysteresis_inverse=self._pair.design.hysteresis_inverse
        )
        self._pair.start(held_rad, motor_rad, self._prefilter.value_px)

    # ------------------------------------------------------------ stages

    def start_from(self, stack_v: Floats) -> None:
        """Begin anew with devices just opened and checked.

        The D/A's outputs, shape (3,), are taken as found: the mirror goes to its bias from there. Every
        interlock is judged anew.
        """
        self.stages.start_from(stack_v)
        self._last_failure = ""
        self.measured.begin()
        self.interlocks.reset_all(self._clock.now_s())
        if self.servo.encoders_jumped:
            self._estimator.forget()
            self._event(
                "warning", "encoders read elsewhere than before; the star's place is forgotten"
            )

    def _siderostat_by(self, step_rad: Floats) -> None:
        self.stages.siderostat_to(self.stages.setpoint_rad + step_rad)

    def _write(self) -> None:
        """Every tick, so that the D/A's watchdog sees that we live."""
        if not self.stages.ready or self.mode in {Mode.OFF, Mode.EXPERIMENT}:
            return
        try:
            self.stages.write()
        except DeviceError as error:
            self.device_failed("D/A", error)

    # ------------------------------------------------------------ records

    def _record(
        self, frame: Frame | None, seen: Seen, frames_lost: int, times_s: tuple[float, float]
    ) -> Tick:
        """What this tick was: names, times and numbers as they are logged.

        `times_s` are when the star was measured, and when it was decided what to do.
        """
        done_s = self._clock.now_s()
        sensed_s, decided_s = times_s
        star, stages, servo = seen.star, self.stages, seen.servo
        read_s, (encoder_az_rad, encoder_el_rad), *_ = servo.reading or _NO_READING
        exposed_s = math.nan if frame is None else frame.mid_exposure_s
        star_az_px, star_el_px = (math.nan, math.nan) if star is None else star[:2]
        target_az_px, target_el_px = self._prefilter.value_px.tolist()
        fsm_az_rad, fsm_el_rad = stages.mirror_rad.tolist()
        stack1_v, stack2_v, stack3_v = stages.stack_v.tolist()
        motor_az_rad, motor_el_rad = seen.motor_rad.tolist()
        setpoint_az_rad, setpoint_el_rad = stages.setpoint_rad.tolist()
        sky_arcsec_per_rad = self._scale.motor_sky_arcsec_per_rad
        return Tick(
            time_s=done_s,
            loop=self.name,
            number=-1 if frame is None else frame.number,
            mode=self.mode.name,
            mode_number=int(self.mode),
            mid_exposure_s=exposed_s,
            frame_age_s=math.nan if frame is None else frame.received_s - exposed_s,
            compute_s=done_s - seen.now_s,
            late=frame is not None and done_s - exposed_s > self._due_after_s,
            frames_lost=frames_lost,
            star_visible=star is not None,
            star_az_px=star_az_px,
            star_el_px=star_el_px,
            star_flux_dn=math.nan if star is None else star.flux_dn,
            window_az_px=-1 if star is None else star.window_az_px,
            window_el_px=-1 if star is None else star.window_el_px,
            target_az_px=target_az_px,
            target_el_px=target_el_px,
            error_az_px=star_az_px - target_az_px,
            error_el_px=star_el_px - target_el_px,
            fsm_az_rad=fsm_az_rad,
            fsm_el_rad=fsm_el_rad,
            fsm_range_fraction=(abs(fsm_az_rad) + abs(fsm_el_rad)) / self.settings.fsm.range_rad,
            fsm_saturated=self.mode is Mode.VERNIER and self._pair.saturated,
            stack1_v=stack1_v,
            stack2_v=stack2_v,
            stack3_v=stack3_v,
            siderostat_az_rad=motor_az_rad,
            siderostat_el_rad=motor_el_rad,
            siderostat_setpoint_az_rad=setpoint_az_rad,
            siderostat_setpoint_el_rad=setpoint_el_rad,
            siderostat_az_sky_arcsec=motor_az_rad * sky_arcsec_per_rad,
            siderostat_el_sky_arcsec=motor_el_rad * sky_arcsec_per_rad,
            search_progress=self.search.progress if self.mode is Mode.ACQUISITION else math.nan,
            fsm_written_s=stages.written_s,
            dac_round_trip_s=stages.round_trip_s,
            amplifier_round_trip_s=servo.round_trip_s,
            following_error_rad=servo.following_rad,
            encoder_read_s=read_s,
            encoder_az_rad=encoder_az_rad,
            encoder_el_rad=encoder_el_rad,
            sense_s=sensed_s - seen.now_s,
            decide_s=decided_s - sensed_s,
        )

    def _near_edge(self, star: Star) -> bool:
        most = HALF_WINDOW_PX - 1.5
        return (
            abs(star.az_px - star.window_az_px) > most or abs(star.el_px - star.window_el_px) > most
        )

    def _event(self, severity: Severity, message: str) -> None:
        self._report(
            Event(
                time_s=self._clock.now_s(),
                severity=severity,
                source=self.name,
                message=message,
            )
        )


def _position(star: Star) -> Floats:
    return np.array([star.az_px, star.el_px])
