"""One stellar loop's tick, from a frame to a command.

frame -> centroid (or star finder) -> interlocks -> mode's control law -> saturate on the mirror's
diamond -> D/A write and siderostat set-point -> record.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import HALF_WINDOW_PX, Rig
from fitctl.controllers.centroid import Star, StarSensor
from fitctl.controllers.coarse import CoarseIntegrator
from fitctl.controllers.estimator import StarEstimator
from fitctl.controllers.prefilter import Prefilter
from fitctl.controllers.spiral import Spiral, plan_spiral
from fitctl.controllers.vernier import Vernier
from fitctl.drivers.interface import DeviceError, Frame, MirrorDac
from fitctl.logging.records import AnyRecord, Event, ModeChange, Severity, Tick
from fitctl.model.optics import mirror_angles, saturate_diamond, scales, stack_volts
from fitctl.supervisor.modes import TRACKING, Mode, Trigger, transition
from fitctl.supervisor.servo import SiderostatServo

Floats = NDArray[np.float64]
_NOWHERE = np.full(2, math.nan)
_SEVERITY: dict[Trigger, Severity] = {
    Trigger.FAULT: "error",
    Trigger.STAR_LOST: "warning",
    Trigger.SEARCH_EXHAUSTED: "warning",
}


@dataclass
class Sighting:
    """A star seen during the search: the siderostat goes back to where it saw it, and looks again."""

    motor_rad: Floats
    since_s: float
    frames: int = 0


@dataclass
class Findings:
    """Consecutive ticks on which something held; they lead to transitions."""

    lost: int = 0
    in_reach: int = 0
    out_of_reach: int = 0


@dataclass
class Commands:
    """What the stages were last told."""

    stack_v: Floats
    mirror_rad: Floats = field(default_factory=lambda: np.zeros(2))
    setpoint_rad: Floats = field(default_factory=lambda: np.zeros(2))


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
        self.dac_ready = False
        self._dac = dac
        self._clock = clock
        self._report = report
        self._scale = scales(rig, loop)
        self._middle_px = np.array([rig.camera.width_px - 1, rig.camera.height_px - 1]) / 2
        self._period_s = rig.camera.period_s
        self._due_after_s = rig.camera.frame_delay_s + rig.supervisor.late_tick_s
        self._sensor = StarSensor(rig.camera, loop)
        self._estimator = StarEstimator(self._scale, self.target_px)
        self._plan = plan_spiral(rig, name)
        self._spiral = Spiral(self._plan)
        self._spiral_centre_rad = np.zeros(2)
        self._sighting: Sighting | None = None
        self._prefilter = Prefilter(loop.prefilter.time_constant_s, self._period_s, self.target_px)
        self._coarse = CoarseIntegrator(
            loop.coarse.gain_rad_per_m, self._scale.pixel_size_m, self._period_s
        )
        self._vernier = Vernier(self._period_s, self._scale.mirror_px_per_rad, loop.fsm.range_rad)
        self._range_px = self._scale.mirror_px_per_rad * loop.fsm.range_rad
        self._travel_rad = loop.siderostat.travel_sky_arcsec / self._scale.motor_sky_arcsec_per_rad
        self._at_travel_limit = False
        self._findings = Findings()
        self._commands = Commands(stack_v=np.full(3, loop.fsm.bias_v))
        # The mirror angle in force at each exposure, for the estimator.
        self._mirror_history: deque[tuple[float, Floats]] = deque(
            [(-math.inf, np.zeros(2))], maxlen=max(8, math.ceil(0.3 / self._period_s))
        )
        self._laws: dict[Mode, Callable[[Star | None], None]] = {
            Mode.OFF: self._rest,
            Mode.STANDBY: self._rest,
            Mode.ACQUISITION: self._search,
            Mode.COARSE: self._pull_in,
            Mode.VERNIER: self._hold_star,
            Mode.SAFE: self._rest,
        }

    # ------------------------------------------------------------ the tick

    def tick(self, frame: Frame | None, frames_lost: int) -> Tick:
        """One tick, with the newest frame or without one."""
        started_s = self._clock.now_s()
        # Where the motors were when the frame was exposed: what it shows belongs to that.
        motor_rad = (
            self.servo.position_rad
            if frame is None
            else self.servo.position_at(frame.mid_exposure_s)
        )
        star = self._sense(frame, motor_rad) if frame is not None else None
        self._judge(frame, star)
        # Without a frame to track by, the stages wait where they are.
        if frame is not None or self.mode not in TRACKING:
            self._laws[self.mode](star)
        self._write()
        done_s = self._clock.now_s()
        return self._tick_record(frame, star, motor_rad, started_s, done_s, frames_lost)

    def _sense(self, frame: Frame, motor_rad: Floats) -> Star | None:
        mirror_rad = self._mirror_at(frame.mid_exposure_s)
        if self.mode in {Mode.COARSE, Mode.VERNIER} and self._findings.lost == 0:
            predicted = self._estimator.predict_px(motor_rad, mirror_rad)
            star = self._sensor.measure(frame.image, *predicted)
            # The estimate may be half a window off after a jump; then the whole frame decides.
            if star is None or self._near_edge(star):
                star = self._sensor.find(frame.image)
        else:
            star = self._sensor.find(frame.image)
        if star is not None and self.mode in TRACKING:
            self._estimator.observe(_position(star), motor_rad, mirror_rad)
        return star

    def _judge(self, frame: Frame | None, star: Star | None) -> None:
        """Interlocks and findings: what leads to another mode."""
        if self.servo.fault is not None:
            self.fail(str(self.servo.fault))
        elif frame is not None and self.mode is Mode.ACQUISITION:
            self._judge_search(frame, star)
        elif frame is not None and self.mode in {Mode.COARSE, Mode.VERNIER}:
            self._judge_tracking(star)

    def _judge_search(self, frame: Frame, star: Star | None) -> None:
        acquisition = self.settings.acquisition
        now_s = frame.mid_exposure_s
        sighting = self._sighting
        if sighting is None:
            if star is not None:
                # Back to where it was seen, with the star in the middle of the field.
                back_rad = self._estimator.motor_for_rad(self._middle_px, np.zeros(2))
                self._sighting = Sighting(back_rad, now_s)
            elif self._spiral.exhausted:
                self.fire(
                    Trigger.SEARCH_EXHAUSTED,
                    f"no star within {acquisition.search_radius_sky_arcsec:g} arcsec of the start; "
                    "check shutter and pointing, then acquire again",
                )
            return
        settled = now_s >= sighting.since_s + acquisition.settle_s
        sighting.frames = sighting.frames + 1 if star is not None and settled else 0
        if sighting.frames >= acquisition.found_frames:
            self.fire(Trigger.STAR_FOUND, f"star on {sighting.frames} frames in a row")
        elif now_s > sighting.since_s + acquisition.settle_s + acquisition.confirm_timeout_s:
            self._event("warning", "a sighting was not confirmed; the search goes on")
            self._sighting = None

    def _judge_tracking(self, star: Star | None) -> None:
        findings, acquisition = self._findings, self.settings.acquisition
        if star is None:
            findings.lost += 1
            findings.in_reach = findings.out_of_reach = 0
            if findings.lost >= acquisition.lost_frames:
                self.fire(Trigger.STAR_LOST, f"no star on {findings.lost} frames in a row")
            return
        findings.lost = 0
        need = float(np.sum(np.abs(self._error_px(star)))) / self._range_px
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
        now_s = self._clock.now_s()
        source, self.mode = self.mode, row.target
        if source is not self.mode:
            self.mode_since_s = now_s
        self._findings = Findings()
        self._enter(source)
        self.last_change = ModeChange(
            time_s=now_s,
            loop=self.name,
            source=source.name,
            target=row.target.name,
            target_number=int(row.target),
            trigger=trigger.name,
            reason=reason,
        )
        self._report(self.last_change)
        self._event(_SEVERITY.get(trigger, "info"), f"{source.name} -> {row.target.name}: {reason}")
        return True

    def fail(self, reason: str) -> None:
        """A device failed: SAFE, or, where that changes nothing, an event; the same failure is told once."""
        if not self.fire(Trigger.FAULT, reason) and reason != self._last_failure:
            self._event("error", reason)
        self._last_failure = reason

    def _enter(self, source: Mode) -> None:
        if self.mode is Mode.SAFE:
            self.servo.stop()
        elif self.mode is Mode.STANDBY:
            self.servo.hold()
            self._commands.setpoint_rad = self.servo.setpoint_rad
        elif self.mode is Mode.ACQUISITION:
            self._start_search()
        elif self.mode is Mode.COARSE:
            self._prefilter.reset(self.target_px)
            sighting, self._sighting = self._sighting, None
            if source is Mode.ACQUISITION and sighting is not None:
                self._coarse.reset(sighting.motor_rad)
        elif self.mode is Mode.VERNIER:
            self._vernier.reset()

    def _start_search(self) -> None:
        """A new spiral, about where the star is expected: on the target, or where it was last seen."""
        motor_rad = self.servo.position_rad
        if not self._estimator.known:
            self._estimator.assume(self.target_px, motor_rad, np.zeros(2))
        # The expected star belongs in the middle of the field, where the search sees farthest.
        self._spiral_centre_rad = self._estimator.motor_for_rad(self._middle_px, np.zeros(2))
        self._spiral = Spiral(self._plan)
        self._sighting = None

    # ------------------------------------------------------------ control laws

    def _rest(self, _star: Star | None) -> None:
        """Mirror back to its bias; the siderostat is held or stopped by its servo."""
        self._mirror_to_bias()

    def _search(self, _star: Star | None) -> None:
        self._mirror_to_bias()
        if self._sighting is not None:
            self._siderostat_to(self._sighting.motor_rad)
            return
        offset_px = self._spiral.advance(self._period_s)
        self._siderostat_to(self._spiral_centre_rad + offset_px / self._scale.motor_px_per_rad)

    def _pull_in(self, star: Star | None) -> None:
        self._mirror_to_bias()
        command_px = self._prefilter.step(self.target_px)
        if star is not None:
            self._siderostat_to(self._coarse.step(_position(star) - command_px))

    def _hold_star(self, star: Star | None) -> None:
        command_px = self._prefilter.step(self.target_px)
        if star is None:
            return
        error_px = _position(star) - command_px
        self._siderostat_to(self._coarse.step(error_px))
        self._mirror_to(self._vernier.step(error_px))

    # ------------------------------------------------------------ stages

    def start_from(self, stack_v: Floats) -> None:
        """Take the D/A's outputs, shape (3,), as found; the mirror goes to its bias from there."""
        self._commands.stack_v = np.array(stack_v, dtype=float)
        self._commands.mirror_rad = self._angles(self._commands.stack_v)
        self.dac_ready = True
        self._last_failure = ""
        if self.servo.encoders_jumped:
            self._estimator.forget()
            self._event(
                "warning", "encoders read elsewhere than before; the star's place is forgotten"
            )

    def at_bias(self) -> bool:
        """The mirror is commanded to its bias."""
        return bool(np.allclose(self._commands.stack_v, self.settings.fsm.bias_v))

    def _mirror_to(self, mirror_rad: Floats) -> None:
        fsm = self.settings.fsm
        self._commands.mirror_rad = saturate_diamond(mirror_rad, fsm.range_rad)
        volts = stack_volts(
            self._commands.mirror_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v
        )
        # Rounding may leave the D/A's range by a part in 1e15.
        self._commands.stack_v = np.clip(volts, 0.0, fsm.dac.full_scale_v)

    def _mirror_to_bias(self) -> None:
        fsm = self.settings.fsm
        most_v = fsm.slew_v_per_s * self._period_s
        left_v = fsm.bias_v - self._commands.stack_v
        self._commands.stack_v = self._commands.stack_v + np.clip(left_v, -most_v, most_v)
        self._commands.mirror_rad = self._angles(self._commands.stack_v)

    def _siderostat_to(self, setpoint_rad: Floats) -> None:
        within = np.clip(setpoint_rad, -self._travel_rad, self._travel_rad)
        limited = bool(np.any(within != setpoint_rad))
        if limited and not self._at_travel_limit:
            self._event(
                "warning",
                f"siderostat at its software limit of {self.settings.siderostat.travel_sky_arcsec:g} "
                "arcsec; it waits there",
            )
        self._at_travel_limit = limited
        self._commands.setpoint_rad = within
        self.servo.move_to(within)

    def _write(self) -> None:
        """Every tick, so that the D/A's watchdog sees that we live."""
        if not self.dac_ready or self.mode is Mode.OFF:
            return
        try:
            self._dac.write_v(self._commands.stack_v)
        except DeviceError as error:
            self.dac_ready = False
            self.fail(str(error))
        self._mirror_history.append((self._clock.now_s(), self._commands.mirror_rad))

    def _angles(self, stack_v: Floats) -> Floats:
        fsm = self.settings.fsm
        return mirror_angles(stack_v, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)

    def _mirror_at(self, time_s: float) -> Floats:
        for since_s, mirror_rad in reversed(self._mirror_history):
            if since_s <= time_s:
                return mirror_rad
        return self._mirror_history[0][1]

    # ------------------------------------------------------------ records

    def _error_px(self, star: Star) -> Floats:
        return _position(star) - self._prefilter.value_px

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

    def _tick_record(
        self,
        frame: Frame | None,
        star: Star | None,
        motor_rad: Floats,
        started_s: float,
        done_s: float,
        frames_lost: int,
    ) -> Tick:
        exposed_s = math.nan if frame is None else frame.mid_exposure_s
        command_px = self._prefilter.value_px
        star_px = _NOWHERE if star is None else _position(star)
        error_px = star_px - command_px
        mirror = self._commands.mirror_rad
        sky = self._scale.motor_sky_arcsec_per_rad * motor_rad
        setpoint = self._commands.setpoint_rad
        return Tick(
            time_s=done_s,
            loop=self.name,
            number=-1 if frame is None else frame.number,
            mode=self.mode.name,
            mode_number=int(self.mode),
            mid_exposure_s=exposed_s,
            frame_age_s=math.nan if frame is None else frame.received_s - exposed_s,
            compute_s=done_s - started_s,
            late=frame is not None and done_s - exposed_s > self._due_after_s,
            frames_lost=frames_lost,
            star_visible=star is not None,
            star_az_px=float(star_px[0]),
            star_el_px=float(star_px[1]),
            star_flux_dn=math.nan if star is None else star.flux_dn,
            window_az_px=-1 if star is None else star.window_az_px,
            window_el_px=-1 if star is None else star.window_el_px,
            target_az_px=float(command_px[0]),
            target_el_px=float(command_px[1]),
            error_az_px=float(error_px[0]),
            error_el_px=float(error_px[1]),
            fsm_az_rad=float(mirror[0]),
            fsm_el_rad=float(mirror[1]),
            fsm_range_fraction=float(np.abs(mirror).sum()) / self.settings.fsm.range_rad,
            fsm_saturated=self.mode is Mode.VERNIER and self._vernier.saturated,
            stack1_v=float(self._commands.stack_v[0]),
            stack2_v=float(self._commands.stack_v[1]),
            stack3_v=float(self._commands.stack_v[2]),
            siderostat_az_rad=float(motor_rad[0]),
            siderostat_el_rad=float(motor_rad[1]),
            siderostat_setpoint_az_rad=float(setpoint[0]),
            siderostat_setpoint_el_rad=float(setpoint[1]),
            siderostat_az_sky_arcsec=float(sky[0]),
            siderostat_el_sky_arcsec=float(sky[1]),
            search_progress=self._spiral.progress if self.mode is Mode.ACQUISITION else math.nan,
        )


def _position(star: Star) -> Floats:
    return np.array([star.az_px, star.el_px])
