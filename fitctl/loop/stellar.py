"""A stellar loop's tick, from a camera frame to commands for mirror and siderostat.

frame -> centroid (or star finder) -> interlocks -> mode's control law -> saturate on the mirror's
diamond -> D/A write and siderostat set-point -> record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop as LoopSettings
from fitctl.config import Rig
from fitctl.controllers.centroid import OtherLight, Star, sensor_noise_px
from fitctl.controllers.design.document import design_json
from fitctl.controllers.pair import Design, Designer
from fitctl.controllers.spiral import plan_spiral
from fitctl.drivers.interface import DeviceError, Frame, LoopDevices
from fitctl.logging.records import ControllerChange, OutputsFound, StarPlace, Tick
from fitctl.loop.experiments import Experiments
from fitctl.loop.following import Following
from fitctl.loop.learning import Learning, is_other_light
from fitctl.loop.link import BacklashFeedforward, Link
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop
from fitctl.loop.observation import Observation
from fitctl.loop.pointing import Pointing, error_from
from fitctl.loop.quantities import StellarQuantities, stellar_places
from fitctl.loop.search.attribution import OtherStages
from fitctl.loop.search.finder import StarFinder
from fitctl.loop.search.star import StarSearch
from fitctl.loop.star_motion import StarMotion
from fitctl.loop.tick_record import TickRecords, TickTimes
from fitctl.messages.commands import Acquire, LearnerReport
from fitctl.messages.modes import FOLLOWING, TRACKING, Finding, Mode, Trigger
from fitctl.messages.telemetry import LoopLimits, LoopState, SpotPlace
from fitctl.model.drives import Drive
from fitctl.model.optics import AzEl, saturate_diamond, scales
from fitctl.stages.journal import Journal
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.periodic import Periodic
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]


class StellarLoop(Loop):
    """One stellar loop: star finder, control laws, mirror.

    Parameters
    ----------
    name : str
    rig : Rig
    siderostat : SiderostatStage
    mirror : MirrorStage
    journal : Journal
    design : Design
        At work in VERNIER at first.
    """

    place_kind = StarPlace

    def __init__(
        self,
        name: str,
        rig: Rig,
        siderostat: SiderostatStage,
        mirror: MirrorStage,
        journal: Journal,
        design: Design,
    ) -> None:
        super().__init__(
            name,
            rig,
            siderostat,
            journal,
            quantities=StellarQuantities(rig, name),
            places=stellar_places(rig, name),
        )
        self.settings: LoopSettings = rig.stellar_loops[name]
        self.quantities: StellarQuantities
        self.backlash: BacklashFeedforward | None = None
        self.others: list[StellarLoop] = []
        self.waits_for = ""
        self.mirror = mirror
        self.target_px = np.array([self.settings.target_px.az, self.settings.target_px.el])
        scale = scales(rig, self.settings)
        self.star_motion = StarMotion(self.settings, scale, rig.camera.period_s)
        self.star_finder = StarFinder(rig, name, self.target_px, self._report_event)
        self.search: StarSearch = StarSearch(rig, name, self.star_finder, lambda: self.target_px)
        self.following = Following(self.settings, scale)
        self.pointing = Pointing(rig, name, self.target_px, design)
        self.learning = Learning(rig, name)
        self._limits = stellar_limits(rig, name)
        self._scale = scale
        self._period_s, self._delay_s = rig.camera.period_s, rig.camera.frame_delay_s
        self._experiments = Experiments(name, scale.motor_px_per_rad, journal)
        self._tick_records = TickRecords(rig, name)
        self._flattened = self._held = False
        self._return_rad: Floats | None = None  # whereto an interlock has stopped the siderostat
        self._moved_s = journal.clock.now_s()
        self._search_due: bool | None = None  # whether it is for a star that was followed
        self._asked_sky_rad = np.zeros(2)  # how far the sky had moved at the command
        self._rig_noise_px = sensor_noise_px(rig.camera, self.settings, self.settings.star_flux_dn)
        self._recalled: StarPlace | None = None  # until the devices are open
        self._held_undone_rad = np.zeros(2)  # of link and sky, as an experiment began
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

    def sense(self, frame: Frame | None, frames_lost: int, frames_skipped: int) -> None:
        """Find the star, and where the stages were when the frame was exposed; without one, where they are."""
        servo = self.servo.read_state()
        begun_s = self._clock.now_s()
        self.mirror.drop_later()
        self._experiments.record_injections(self.mirror)
        if self._writes_dac:
            self._use_dac(self._find_mirror)
        star = None
        if frame is None:
            mirror_rad, motor_rad = self.mirror.now_rad, servo.position_rad
        else:
            motor_rad = self.servo.position_at(frame.mid_exposure_s)
            mirror_rad = self.mirror.at(frame.mid_exposure_s)
        time_s = begun_s if frame is None else frame.mid_exposure_s
        motion = self.star_motion
        motion.read_at(time_s)
        link, sky, link_rad = motion.link, motion.sky, motion.turned_rad
        if frame is not None:
            beam_rad = motor_rad if link_rad is None else motor_rad + link_rad
            star = self._find(frame, mirror_rad, motor_rad, beam_rad)
        self.observation = Observation(
            frame,
            frames_lost,
            frames_skipped,
            star,
            mirror_rad,
            motor_rad,
            servo,
            begun_s,
            link_rad,
            None if link is None else link.motor_rad,
            None if sky is None else sky.turned_rad,
            None if self.backlash is None else self.backlash.at(time_s),
        )
        self._sensed_s = self._clock.now_s()

    def decide(self) -> None:
        """Errors and findings first, then interlocks, then the mode's control law."""
        observation = self.observation
        self._evaluate_waiting(observation)
        self._evaluate_findings(observation)
        self.quantities.record_observation(observation)
        self.quantities.record_stages(observation, self.siderostat, self.mirror)
        self._evaluate_interlocks(observation.now_s)
        self._evaluate_learning(observation)
        self._move(observation)
        self._decided_s = self._clock.now_s()

    def send(self) -> None:
        """Send the D/A its voltages, at every tick, so that its watchdog sees that we live."""
        if self._writes_dac:
            self._use_dac(self.mirror.send)

    def confirm(self) -> None:
        """Wait until the D/A confirms its voltages."""
        self._use_dac(self.mirror.confirm)
        self._done_s = self._clock.now_s()

    @property
    def _writes_dac(self) -> bool:
        return self.mirror.ready and self.mode not in {Mode.OFF, Mode.EXPERIMENT}

    def _find_mirror(self) -> None:
        """After a pause without writes, go on from where the D/A's own watchdog has put the mirror."""
        try:
            found_v = self.mirror.find_after_pause()
        except DeviceError:
            self._record_found(np.full(3, math.nan))
            raise
        if found_v is not None:
            self._record_found(found_v)
            self._report_event(
                "warning",
                "the D/A's outputs are not those last written: its own watchdog has moved the mirror; "
                "the loop goes on from there",
            )

    def _record_found(self, stack_v: Floats) -> None:
        v1, v2, v3 = stack_v.tolist()
        self._journal.record(
            OutputsFound(
                time_s=self._clock.now_s(), loop=self.name, stack1_v=v1, stack2_v=v2, stack3_v=v3
            )
        )

    def _use_dac(self, action: Callable[[], None]) -> None:
        try:
            action()
        except DeviceError as error:
            self.device_failed("D/A", error)

    def tick_record(self) -> Tick:
        """What the tick was decided by, and what it did."""
        tick = self._tick_records.make(
            self.mode,
            self.observation,
            self.siderostat,
            self.mirror,
            self.pointing,
            self.search,
            TickTimes(self._sensed_s, self._decided_s, self._done_s),
            held=self._held,
        )
        self.quantities.record_tick(tick.compute_s, tick.time_s)
        return tick

    def _move(self, observation: Observation) -> None:
        """Follow the link and the mode's law, unless an interlock holds or flattens."""
        stopped = self._is_stopped
        self._rest_return(observation, stopped=stopped)
        if not stopped:
            self.star_motion.undo(
                self.siderostat,
                observation.now_s,
                tracked=self.mode in TRACKING,
                searched=self._search_due is None,
            )
        flattens = stopped and self.interlocks.action == "flatten"
        if flattens:
            self.mirror.step_to_bias()
        elif self._flattened and self.mode is Mode.VERNIER:
            self._start_pair(observation.beam_rad)
        self._flattened = flattens
        waits = self._waits
        # Without a frame to track by, the stages wait where they are.
        self._held = stopped or waits or (self.mode in TRACKING and observation.frame is None)
        passed_s, self._moved_s = observation.now_s - self._moved_s, observation.now_s
        self._rest_search(observation.servo, passed_s, (stopped, waits))
        if not self._held:
            self._laws[self.mode](observation)
        self._follow_plays(observation)

    @property
    def _waits(self) -> bool:
        """The loop waits for others, or is about to."""
        due = self.mode is Mode.ACQUISITION and self._search_due is not None
        return due or (self.mode in TRACKING and bool(self.waits_for))

    def _rest_return(self, observation: Observation, *, stopped: bool) -> None:
        """A siderostat on its way back to its star stops for an interlock, and goes on after it."""
        follows = self.mode in FOLLOWING
        if self._return_rad is not None and not (stopped and follows):
            if follows:
                self.siderostat.undo_to(self._return_rad)
            self._return_rad = None
        elif self._return_rad is None and stopped and follows and self.waits_for:
            self._return_rad = self.siderostat.wanted_rad
            self.siderostat.hold(observation.servo.newest_rad)

    def _follow_plays(self, observation: Observation) -> None:
        """The mirror makes up for backlash in VERNIER only, and then from where the plays are."""
        if self.backlash is None:
            return
        if self.mode is not Mode.VERNIER:
            self.backlash.rest(observation.now_s, observation.servo)
        elif self._held or observation.star is None:
            self.backlash.follow(observation.servo)

    @property
    def _is_stopped(self) -> bool:
        """An interlock keeps the stages from following the star."""
        return self.mode in TRACKING and self.interlocks.holds

    def _evaluate_learning(self, observation: Observation) -> None:
        """Go back to the design before, where the learnt one does worse."""
        frame, star = observation.frame, observation.star
        if frame is None:
            return
        target_px = self.pointing.command_px
        why_back = self.learning.observe(
            observation.now_s,
            frame.mid_exposure_s,
            None if star is None else error_from(target_px, star),
            target_px,
            (observation.law_mirror_rad, observation.beam_rad),
            saturated=self.pointing.saturated,
            hindered=self.mode is not Mode.VERNIER or bool(self.waits_for) or self._is_stopped,
        )
        if why_back and self.learning.before is not None:
            self.learning.fell_back(why_back, observation.now_s)
            self.use(self.learning.before, why_back, by_itself=True)

    def _find(
        self, frame: Frame, mirror_rad: Floats, motor_rad: Floats, beam_rad: Floats
    ) -> Star | None:
        self.star_finder.exclude(
            (other.spots for other in self.others),
            (other.candidate_spots(frame.mid_exposure_s) for other in self.others),
        )
        if self.mode is Mode.ACQUISITION and (
            self._search_due is not None
            or self.waits_for
            or not self.search.has_arrived(motor_rad, beam_rad)
        ):
            return None  # what is seen on the way is another star
        follows = self.mode in FOLLOWING and self.following.lost == 0
        is_pointed_at = self.star_finder.look_at_px is not None
        again = self.search.again
        star = self.star_finder.find(
            frame.image, self.mode, beam_rad, mirror_rad, follows=follows, again=again
        )
        if is_pointed_at and star is not None:
            self.following.begin()  # it may be another star than before
        return star

    @property
    def spots(self) -> list[OtherLight]:
        """What other loops must not measure: the star, then what moves with it; empty if none is followed."""
        return self.star_finder.spots() if self.mode in FOLLOWING else []

    def candidate_spots(self, time_s: float) -> list[OtherLight]:
        """What a search looks at a second time, where the stages have it at a recent time; empty without."""
        attribution = self.star_finder.attribution
        searches = self.mode is Mode.ACQUISITION and not self.waits_for
        if not searches or attribution is None or attribution.candidate is None:
            return []
        return self.star_finder.spots(attribution.moved_px(self._stages_px_at(time_s)))

    def _stages_px_at(self, time_s: float) -> AzEl:
        """How far the stages move the star at a recent time."""
        beam_rad = self.star_motion.beam_at(time_s, self.servo.position_at(time_s))
        return self.star_finder.estimator.stages_px(beam_rad, self.mirror.at(time_s))

    def _evaluate_findings(self, observation: Observation) -> None:
        """Errors of devices, and what the frame means for the mode."""
        servo, injector = observation.servo, self.mirror.injector
        if servo.fault is not None:
            self.device_failed("siderostat", servo.fault)
        elif self.mode is Mode.EXPERIMENT and injector.fault is not None:
            self.mirror.ready = False
            self.device_failed("injector", injector.fault)
        elif self.mirror.fault is not None:
            fault, self.mirror.fault = self.mirror.fault, None
            self.device_failed("D/A between frames", fault)
        elif (frame := observation.frame) is not None and not self.waits_for:
            found = self._find_trigger(frame, observation.star)
            if found is not None and found.trigger is None:
                self._report_event("warning", found.reason)
            elif found is not None and found.trigger is not None:
                self.fire(found.trigger, found.reason)

    def _find_trigger(self, frame: Frame, star: Star | None) -> Finding | None:
        if self.mode is Mode.ACQUISITION:
            others = {
                other.name: OtherStages(
                    other._stages_px_at(frame.mid_exposure_s),
                    follow=other.mode in FOLLOWING,
                    lost=other.observation.star is None and not other.waits_for,
                    target_px=other.target_px,
                )
                for other in self.others
            }
            return self.search.evaluate(star, others, frame.mid_exposure_s)
        if self.mode in FOLLOWING:
            return self._find_unmoved(star) or self.following.evaluate(
                self.mode, star, self.pointing.command_px
            )
        return None

    def _find_unmoved(self, star: Star | None) -> Finding | None:
        """What the stages do not move is not the loop's star; that is expected where it last was for sure."""
        link = self.star_motion.link
        # An experiment moves the star off its target, and with a feedforward of 0 so does what the link turns.
        if self.mode is Mode.EXPERIMENT or (link is not None and not link.matrix.any()):
            return None
        estimator, observation = self.star_finder.estimator, self.observation
        stages_px = estimator.stages_px(observation.beam_rad, observation.mirror_rad)
        following = self.following
        found = following.unmoved(star, stages_px, self.pointing.command_px)
        if found is not None:
            az_px, el_px = following.off_star_px
            stages_az_px, stages_el_px = following.off_stages_px
            estimator.observe((az_px, el_px), (stages_az_px, stages_el_px))
        return found

    # ------------------------------------------------------------ modes

    def _enter(self, source: Mode, motor_rad: Floats) -> None:
        self.following.begin()
        if source is Mode.EXPERIMENT:
            self._end_experiment(motor_rad)
        super()._enter(source, motor_rad)
        if self.mode is Mode.ACQUISITION:
            self._search_due = source in FOLLOWING
            self._asked_sky_rad = self.star_motion.sky_rad
            if not self._why_wait(self._clock.now_s(), motor_rad):
                self._start_search(motor_rad)
        elif self.mode is Mode.COARSE:
            self.pointing.start_coarse(self.target_px)
        elif self.mode is Mode.VERNIER:
            self._start_pair(self.star_motion.beam_rad(motor_rad))

    def _start_pair(self, beam_rad: Floats) -> None:
        """The pair goes on from where the mirror is, with all siderostats at `beam_rad`, shape (2,)."""
        held_rad = self.mirror.held_rad(hysteresis_inverse=self._inverts_hysteresis)
        if self.backlash is not None:
            self.backlash.begin(self.backlash.offset_rad)
            held_rad = held_rad - self.backlash.offset_rad
        self.pointing.start_pair(held_rad, beam_rad)

    @property
    def _inverts_hysteresis(self) -> bool:
        """As the design asks; but no measurement corrects what makes up for backlash, so that must be exact."""
        return self.backlash is not None or self.pointing.design.hysteresis_inverse

    def _read_link(self, now_s: float) -> AzEl:
        return self.star_motion.read_now(now_s)

    def configure_search(self, asked: Acquire) -> None:
        """What the next search is to find, and how, as a command asks that was not refused."""
        flux_dn = asked.star_flux_dn or self.settings.star_flux_dn
        noise_px, before_px = map(
            self.star_finder.noise_px, (flux_dn, self.quantities.star_flux_dn)
        )
        if is_other_light(noise_px, before_px):
            self.learning.forget_advice()
            if self.learning.before:
                # Of the design before, another can be made for the new star's light.
                why = (
                    f"the next star has {flux_dn:g} DN, and the learnt design is for another light"
                )
                self.use(self.learning.before, why, by_itself=True)
        self.star_finder.expect_flux(flux_dn)
        self.quantities.star_flux_dn = flux_dn
        self.star_motion.expect_rate(asked, self._clock.now_s())
        self.search.configure(asked)

    def _start_search(self, motor_rad: Floats) -> None:
        """As asked; else about where the star is expected: on the target, or where it was last seen."""
        again, self._search_due = bool(self._search_due), None
        if self.star_motion.count_link(anew=self.search.asked_place_sky_arcsec is not None):
            self.star_finder.estimator.forget()
        self.star_finder.estimator.expect(
            self.target_px, self.star_motion.beam_rad(motor_rad), np.zeros(2)
        )
        self.search.start_where_expected(self._asked_sky_rad, again=again)

    # ------------------------------------------------------------ the link, and other loops

    def join(self, loops: Mapping[str, Loop]) -> None:
        """Know the loop of the link, and those whose stars are on the same camera."""
        if self.settings.link is not None:
            link = loops[self.settings.link]
            if not isinstance(link, MetrologyLoop):
                msg = f"loops.{self.name}.link: {link.name} is no metrology loop"
                raise TypeError(msg)
            self.star_motion.link = Link(link, self.settings)
            given = self.settings.feedforward
            if given is not None and given.gain and given.signal == "encoders+backlash":
                self.backlash = BacklashFeedforward(
                    self.star_motion.link, self.siderostat, self.settings, self._scale
                )
        self.others = [
            loop for loop in loops.values() if isinstance(loop, StellarLoop) and loop is not self
        ]

    def _why_wait(self, now_s: float, motor_rad: Floats) -> str:
        """What the loop waits for; empty if for nothing."""
        if self.mode not in TRACKING:
            return ""
        link = self.star_motion.link
        if link is not None:
            if not link.settled(now_s):
                loop = link.loop
                return f"the link of {loop.name}, which is in {loop.mode.name}"
            # After a link's return the siderostat may have far to go.
            goal_rad = (
                self.siderostat.setpoint_rad if self._return_rad is None else self._return_rad
            )
            if self.waits_for and not self.search.is_near(motor_rad, goal_rad):
                return "its siderostat, which is on its way to the star"
        if self.mode is Mode.ACQUISITION and self._search_due is not None:
            # Two stars look alike: only the own one moves while the other loop's stages stand still.
            busy = [other.name for other in self.others if other.is_acquiring]
            if busy:
                return f"{', '.join(busy)}, which searches for its star"
        return ""

    @property
    def is_acquiring(self) -> bool:
        """Its star is searched for, and was not followed before."""
        if self.mode is not Mode.ACQUISITION or self.waits_for:
            return False
        return self._search_due is None and not self.search.again

    def _evaluate_waiting(self, observation: Observation) -> None:
        """Wait where the stages are, or go on, and report which."""
        self._forget_with_link_zero()
        before, waits_for = self.waits_for, self._why_wait(observation.now_s, observation.motor_rad)
        self.waits_for = waits_for
        if waits_for and not before:
            self._report_event("warning", f"waits for {waits_for}; the stages stay where they are")
        if waits_for and self.mode is Mode.EXPERIMENT:
            self.fire(Trigger.EXPERIMENT_DONE, f"waits for {waits_for}")
        if waits_for or self.mode not in TRACKING:
            return
        if before:
            self._report_event("info", f"no longer waits for {before}")
            self._go_on(observation)
        if self.mode is Mode.ACQUISITION and self._search_due is not None:
            self._start_search(observation.motor_rad)

    def _forget_with_link_zero(self) -> None:
        """The star is expected with the link as it was; if that counts from elsewhere now, nowhere."""
        if not self.star_motion.link_zero_was_lost():
            return
        if self.star_finder.estimator.origin_px is not None:
            self._report_event(
                "warning",
                f"encoders of {self.settings.link} read elsewhere than before; the star's place is forgotten",
            )
        self.star_finder.estimator.forget()

    def _go_on(self, observation: Observation) -> None:
        """The control laws begin anew from where the stages are."""
        self.following.begin()
        if self.mode is Mode.COARSE:
            self.pointing.start_coarse(self.target_px)
        elif self.mode is Mode.VERNIER:
            self._start_pair(observation.beam_rad)

    # ------------------------------------------------------------ control laws

    def _rest(self, _observation: Observation) -> None:
        """Mirror back to its bias; the siderostat is held or stopped by its servo."""
        self.mirror.step_to_bias()

    def _stand_by(self, _observation: Observation) -> None:
        """Both stages rest where the operator has put them."""
        self.mirror.step_to_rest()

    def _search(self, observation: Observation) -> None:
        self.mirror.step_to_rest()
        # If the search has begun in this tick, what the link turns counts from elsewhere than when it was read.
        beam_rad = self.star_motion.beam_rad(observation.motor_rad)
        wanted_rad = self.search.advance_from(observation.motor_rad, beam_rad, self._period_s)
        self.siderostat.move_to(self.star_motion.setpoint_rad(wanted_rad))

    def _pull_in(self, observation: Observation) -> None:
        self.mirror.step_to_rest()
        step_rad = self.pointing.step_coarse(observation, self.target_px)
        if step_rad is not None:
            self.siderostat.move_by(step_rad)

    def _hold_star(self, observation: Observation) -> None:
        command = self.pointing.step_pair(observation, self.target_px)
        if command is not None:
            self.siderostat.move_by(command.motor_step_rad)
            mirror_rad, *later_rad = command.mirror_rad, *command.later_rad
            if self.backlash is not None:
                self.backlash.update(observation.now_s, observation.servo)
                mirror_rad, *later_rad = (
                    saturate_diamond(each + self.backlash.offset_rad, self.settings.fsm.range_rad)
                    for each in (mirror_rad, *later_rad)
                )
            inverts = self._inverts_hysteresis
            self.mirror.move_to(mirror_rad, hysteresis_inverse=inverts)
            if later_rad and observation.frame is not None:
                every_s = self._period_s / (1 + len(later_rad))
                first_s = observation.frame.mid_exposure_s + self._delay_s + every_s
                self.mirror.move_later(later_rad, first_s, every_s, hysteresis_inverse=inverts)

    def _run_experiment(self, observation: Observation) -> None:
        setpoint_rad = self._experiments.setpoint_rad(observation.now_s)
        if setpoint_rad is None:
            self.fire(Trigger.EXPERIMENT_DONE, "all motions done")
        else:
            self.siderostat.undo_to(setpoint_rad + self._undone_since_held())

    def _undone_since_held(self) -> Floats:
        """How far link and sky have moved the siderostat since an experiment began, shape (2,)."""
        return self._held_undone_rad - self.star_motion.undone_rad

    # ------------------------------------------------------------ designs and experiments

    @property
    def controller(self) -> str:
        """The design at work in VERNIER."""
        return self.pointing.design.title

    @property
    def noise_px(self) -> float | None:
        """The sensor's noise that the design was made for, where it is not the one of the rig file's light."""
        design = self.pointing.design
        noise_px: float | None = design.parameters.get("noise_px")
        return noise_px if design.uses_noise and noise_px != self._rig_noise_px else None

    def use(
        self,
        design: Design,
        reason: str = "",
        *,
        report: LearnerReport | None = None,
        by_itself: bool = False,
    ) -> None:
        """Work with another design from the next tick on; in VERNIER the mirror goes on where it is.

        A learnt design comes with its report; `by_itself` is without an operator's command.
        """
        self.learning.changed(
            self.pointing.design, design, report, self.pointing.recent, by_itself=by_itself
        )
        now_s, before, motor_rad = self._clock.now_s(), self.controller, self.servo.position_rad
        link_rad = self._read_link(now_s)
        self.pointing.use(design)
        if self.mode is Mode.VERNIER and not self.pointing.start_knowing():
            self._start_pair(self.star_motion.beam_rad(motor_rad))
        az_rad, el_rad = motor_rad.tolist()
        link_az_rad, link_el_rad = link_rad
        self._journal.record(
            ControllerChange(
                time_s=now_s,
                loop=self.name,
                source=before,
                target=design.title,
                siderostat_az_rad=az_rad,
                siderostat_el_rad=el_rad,
                link_az_rad=link_az_rad,
                link_el_rad=link_el_rad,
                reason=reason,
                design_json=design_json(design),
            )
        )
        why = f": {reason}" if reason else ""
        self._report_event("info", f"controller {before} -> {design.title}{why}")

    def start_experiment(self, name: str, drives: list[Drive]) -> None:
        """Make an experiment's motions from the next tick on; nothing in a mode without a star."""
        now_s = self._clock.now_s()
        if not self.fire(Trigger.EXPERIMENT, name):
            return
        self._held_undone_rad = self.star_motion.undone_rad
        self._experiments.begin(name, drives, self.siderostat, self.mirror, now_s)

    def _end_experiment(self, motor_rad: Floats) -> None:
        held_rad = self._experiments.end(self.mirror)
        # After a wait, the star is pulled in from where the experiment has left it.
        if held_rad is None or self.mode is Mode.SAFE or self.waits_for:
            return
        back_rad = held_rad + self._undone_since_held()
        if self.interlocks.holds:
            self._return_rad = back_rad
            self.siderostat.hold(motor_rad)
        else:
            self.siderostat.undo_to(back_rad)

    # ------------------------------------------------------------ for the supervisor

    @property
    def periodic(self) -> list[Periodic]:
        """The siderostat's servo, and the injector of experiments."""
        return [self.servo, self.mirror.injector]

    def state(self, now_s: float) -> LoopState:
        """The newest of everything, for consoles."""
        scale, mode, design = self._scale, self.mode, self.pointing.design
        centre_rad, link = self.search.centre_rad - self.star_motion.sky_rad, self.star_motion.link
        if link is not None:
            centre_rad = centre_rad - link.undone_from_origin_rad
        centre_sky_arcsec = (
            centre_rad * self.settings.siderostat.sky_arcsec_per_motor_rad
        ).tolist()
        az_urad, el_urad = (1e6 * self.mirror.bias_offset_rad).tolist()
        return LoopState(
            name=self.name,
            mode=mode.name,
            since_s=self.mode_since_s,
            requirement_px=self.settings.requirement_px,
            sky_arcsec_per_px=scale.sky_arcsec_per_px,
            usable_commands=[trigger.name.capitalize() for trigger in self.usable_commands],
            controller=self.controller,
            last_change=self.last_change,
            interlocks=list(self.interlocks.tripped),
            limits=self._limits,
            watched=self.interlocks.watched(now_s, self.quantities.readings),
            bias_offset_urad=(az_urad, el_urad),
            search_centre_sky_arcsec=tuple(centre_sky_arcsec) if mode is Mode.ACQUISITION else None,
            other_spots=[
                SpotPlace(
                    name=spot.name, az_offset_px=spot.offset_px.az, el_offset_px=spot.offset_px.el
                )
                for spot in self.settings.other_spots
            ],
            controller_file=design.file,
            controller_digest=design.digest if design.file else "",
            search_again=self.search.state_again(self.mode_since_s)
            if mode is Mode.ACQUISITION
            else None,
            waits_for=self.waits_for,
            learning=self.learning.state,
            noise_px=self.noise_px,
        )

    def begin(self, stack_v: Floats | None) -> None:
        """Begin anew; the mirror goes to its bias from the D/A's outputs as found.

        If the encoders count from elsewhere than before, the star's place is unknown.
        """
        if stack_v is not None:
            self.mirror.start_from(stack_v)
        super().begin(stack_v)
        jumped, self.servo.encoders_jumped = self.servo.encoders_jumped, False
        recalled, self._recalled = self._recalled, None
        if jumped:
            self.star_motion.forget()
            self.star_finder.estimator.forget()
            self._report_event(
                "warning", "encoders read elsewhere than before; the star's place is forgotten"
            )
        elif self.servo.turned_on_rad:
            turned_arcsec = (
                self.servo.turned_on_rad * self.settings.siderostat.sky_arcsec_per_motor_rad
            )
            self._report_event(
                "warning",
                f"the siderostat turned on by {turned_arcsec:.0f} arcsec on the sky while its amplifiers did "
                "not answer; the star's place is kept, and acquire goes back there",
            )
        self._forget_with_link_zero()
        if recalled is not None and self.star_finder.estimator.origin_px is not None:
            now_s = self._clock.now_s()
            moved = self.star_motion.moved_by(now_s)
            self._journal.record(msgspec.structs.replace(recalled, time_s=now_s, **moved))
            self._report_event(
                "info",
                "the star's place is known from before the supervisor was killed; acquire goes back there",
            )

    @property
    def place(self) -> StarPlace | None:
        """Where its star is; None where nothing is known of it."""
        estimator = self.star_finder.estimator
        # Encoders that have jumped since the star was found have another zero than its place.
        link = self.star_motion.link
        jumped = self.servo.encoders_jumped or (link is not None and link.zero_is_lost)
        if estimator.origin_px is None or jumped:
            return None
        az_rad, el_rad = self.servo.position_rad.tolist()
        link_motor_rad = link_rad = np.zeros(2)
        if link is not None:
            link_motor_rad = link.servo.position_rad
            link_rad = link.turned_with(link_motor_rad)
        link_az_px, link_el_px = estimator.stages_px(link_rad, np.zeros(2))
        link_az_rad, link_el_rad = link_motor_rad.tolist()
        now_s = self._clock.now_s()
        return StarPlace(
            time_s=now_s,
            loop=self.name,
            az_px=estimator.origin_px[0] + link_az_px,
            el_px=estimator.origin_px[1] + link_el_px,
            siderostat_az_rad=az_rad,
            siderostat_el_rad=el_rad,
            link_az_rad=link_az_rad,
            link_el_rad=link_el_rad,
            **self.star_motion.moved_by(now_s),
        )

    def recall(self, place: StarPlace) -> None:
        """Expect the star where a supervisor that was killed had it."""
        self._recalled = place
        self.servo.recall((place.siderostat_az_rad, place.siderostat_el_rad))
        self.star_motion.recall(place)
        self.star_finder.estimator.observe((place.az_px, place.el_px), (0.0, 0.0))

    def release(self) -> None:
        """Send the D/A nothing more."""
        self.mirror.ready = False

    def rest(self) -> None:
        """From now on the mirror rests at its bias."""
        self.mirror.rest_at_bias()

    def at_rest(self) -> bool:
        """The mirror is at its bias, if it can still be commanded."""
        return not self.mirror.ready or self.mirror.at_bias()


def stellar_loop(
    name: str, rig: Rig, devices: LoopDevices, journal: Journal, design: Designer
) -> StellarLoop:
    """A stellar loop on its devices.

    Raises
    ------
    ValueError
        If there is no D/A among them.
    """
    if devices.dac is None:
        msg = f"loop {name}: a stellar loop needs the D/A of its mirror"
        raise ValueError(msg)
    servo = SiderostatServo(
        name, rig.stellar_loops[name], devices.amplifiers, journal.clock, rig.camera.period_s
    )
    mirror = MirrorStage(rig, name, devices.dac, journal.clock)
    siderostat = SiderostatStage(rig, name, servo)
    return StellarLoop(name, rig, siderostat, mirror, journal, design(rig, name, ""))


def stellar_limits(rig: Rig, name: str) -> LoopLimits:
    """How far the loop's stages go, and what its search does."""
    loop = rig.stellar_loops[name]
    return LoopLimits(
        fsm_range_rad=loop.fsm.range_rad,
        siderostat_travel_sky_arcsec=loop.siderostat.travel_sky_arcsec,
        search_radius_sky_arcsec=loop.acquisition.search_radius_sky_arcsec,
        spiral_pitch_sky_arcsec=plan_spiral(rig, name).pitch_px
        * scales(rig, loop).sky_arcsec_per_px,
    )
