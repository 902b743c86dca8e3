"""A metrology loop's tick, from a sample of its photodiodes to its siderostat's set-point.

sample -> beam's place -> interlocks -> mode's control law -> siderostat set-point -> next sample -> record.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, Rig
from fitctl.config import MetrologyLoop as MetrologySettings
from fitctl.controllers.beam_hold import BeamHold
from fitctl.controllers.frame_counts import count_sample
from fitctl.controllers.photodiodes import Beam, BeamState, PhotodiodeArray
from fitctl.controllers.spiral import plan_beam_spiral
from fitctl.drivers.interface import (
    NO_READING,
    DeviceError,
    DiodeReading,
    Frame,
    LoopDevices,
    Photodiodes,
)
from fitctl.logging.records import BeamPlace, MetrologyTick
from fitctl.loop.loop import Loop
from fitctl.loop.quantities import MetrologyQuantities, metrology_places
from fitctl.loop.search.beam import BeamSearch
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import (
    BEAM_FOLLOWING,
    METROLOGY_TRANSITIONS,
    Finding,
    Mode,
    Trigger,
)
from fitctl.messages.telemetry import LoopLimits, LoopState
from fitctl.model.optics import rotation, sky_px_per_rad
from fitctl.stages.journal import Journal
from fitctl.stages.servo import ServoState, SiderostatServo
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]
IN_REACH = 3.0  # times the requirement: nearer to the centre than this, the beam is held (choice)
OUT_OF_REACH = 20.0  # times the requirement: farther, it is pulled in again (choice)
PULL_IN = (
    0.5  # of the motors' velocity limit: faster, a beam that is far off is not pulled in (choice)
)
MOST_TICK_S = 0.1  # a longer wait between two ticks counts as this: the law was not made for it
_NO_SAMPLE = DiodeReading(math.nan, (math.nan,) * 4)
_NO_BEAM = Beam(BeamState.LOST, math.nan, math.nan, math.nan, math.nan, math.nan)


class _Sensed(NamedTuple):
    """What a tick is decided by.

    `sample` and `beam` are None at a tick without a new sample; `motor_rad` is where the motors were when it
    was taken, without one where they are now.
    """

    frame: Frame | None
    frames_lost: int
    servo: ServoState
    sample: DiodeReading | None
    beam: Beam | None
    motor_rad: Floats
    begun_s: float


class MetrologyLoop(Loop):
    """One metrology loop: photodiodes, search, and the law that holds the beam on their centre.

    Parameters
    ----------
    name : str
    rig : Rig
    siderostat : SiderostatStage
    photodiodes : Photodiodes
    journal : Journal

    Attributes
    ----------
    search : BeamSearch
    hold : BeamHold
    lost, in_reach, out_of_reach : int
        Samples in a row, by :func:`fitctl.controllers.frame_counts.count_sample`.
    zeros_lost : int
        How often the encoders were found to read elsewhere than before, when the devices were opened.
    """

    transitions = METROLOGY_TRANSITIONS
    place_kind = BeamPlace

    def __init__(
        self,
        name: str,
        rig: Rig,
        siderostat: SiderostatStage,
        photodiodes: Photodiodes,
        journal: Journal,
    ) -> None:
        super().__init__(
            name,
            rig,
            siderostat,
            journal,
            quantities=MetrologyQuantities(rig, name),
            places=metrology_places(rig, name),
        )
        self.settings: MetrologySettings = rig.metrology_loops[name]
        settings = self.settings
        self.quantities: MetrologyQuantities
        self.search: BeamSearch = BeamSearch(rig, name)
        self.hold = BeamHold(settings.hold.crossover_hz, settings.hold.second_integrator_hz)
        self._array = PhotodiodeArray(settings.sensor, settings.acquisition.detection_sigma)
        self._photodiodes = photodiodes
        self._photodiode_error: DeviceError | None = None
        self._asked = Acquire()
        self.zeros_lost = 0
        self._recalled: BeamPlace | None = None  # until the devices are open
        self._motor_sky = settings.siderostat.sky_rad_per_motor_rad
        self._turn = rotation(settings.siderostat.rotation_deg)
        self._pull_in_rad_s = PULL_IN * settings.siderostat.velocity_limit_rad_s * self._motor_sky
        self._hold_most_rad = hold_most_rad(settings)
        self._late_s = rig.camera.frame_delay_s + rig.supervisor.late_tick_s
        self._period_s = rig.camera.period_s
        self._sky_arcsec_per_px = ARCSEC_PER_RAD / sky_px_per_rad(rig)
        self._limits = metrology_limits(rig, name)
        self._ready = False
        self._sampled_s = math.nan
        self._ticked_s = self._requested_s = math.nan
        self.lost = self.in_reach = self.out_of_reach = 0  # samples in a row
        self._laws: dict[Mode, Callable[[_Sensed, float], None]] = {
            Mode.ACQUISITION: self._search,
            Mode.COARSE: self._pull_in,
            Mode.LOCKED: self._hold_beam,
        }

    # ------------------------------------------------------------ the tick

    def sense(self, frame: Frame | None, frames_lost: int, frames_skipped: int) -> None:
        """Find the beam on the newest sample, and where the motors were when it was taken."""
        servo = self.servo.read_state()
        begun_s = self._clock.now_s()
        sample = self._receive()
        beam = None if sample is None else self._array.beam(sample.volts)
        motor_rad = servo.position_rad if sample is None else self.servo.position_at(sample.time_s)
        self._sensed = _Sensed(frame, frames_lost, servo, sample, beam, motor_rad, begun_s)
        self._sensed_s = self._clock.now_s()

    def _receive(self) -> DiodeReading | None:
        if not self._ready:
            return None
        try:
            sample = self._photodiodes.receive()
        except DeviceError as error:
            self._photodiode_error = error
            return None
        if sample is not None:
            self._sampled_s = sample.time_s
        return sample

    def decide(self) -> None:
        """Errors and findings first, then interlocks, then the mode's control law."""
        sensed = self._sensed
        self._evaluate_findings(sensed)
        now_s, quantities = sensed.begun_s, self.quantities
        quantities.record_siderostat(sensed.servo, self.siderostat, now_s)
        if sensed.beam is not None:
            quantities.record_beam(sensed.beam, now_s)
        if self._ready:
            quantities.record_sample_age(now_s - self._sampled_s, now_s)
        self._evaluate_interlocks(now_s)
        since_s = 0.0 if math.isnan(self._ticked_s) else now_s - self._ticked_s
        duration_s = min(since_s, MOST_TICK_S)
        self._ticked_s = now_s
        law, holds = self._laws.get(self.mode), self.interlocks.holds
        self._rest_search(sensed.servo, since_s, (holds,))
        if law is not None and not holds:
            law(sensed, duration_s)
        self._decided_s = self._clock.now_s()

    def send(self) -> None:
        """Ask for the next sample."""
        self._requested_s = math.nan
        if not self._ready or self.mode is Mode.OFF:
            return
        self._requested_s = self._clock.now_s()
        try:
            self._photodiodes.send_request()
        except DeviceError as error:
            self._photodiodes_failed(error)

    def confirm(self) -> None:
        """Nothing is to be confirmed: the sample is read at the next tick."""
        self._done_s = self._clock.now_s()

    def _photodiodes_failed(self, error: DeviceError) -> None:
        self._ready = False
        self.device_failed("photodiodes", error)

    def _evaluate_findings(self, sensed: _Sensed) -> None:
        """Errors of devices, and what the sample means for the mode."""
        error, self._photodiode_error = self._photodiode_error, None
        if sensed.servo.fault is not None:
            self.device_failed("siderostat", sensed.servo.fault)
        elif error is not None:
            self._photodiodes_failed(error)
        elif sensed.sample is not None and sensed.beam is not None:
            found = self._find_trigger(sensed.sample, sensed.beam, sensed.motor_rad)
            if found is not None and found.trigger is None:
                self._report_event("warning", found.reason)
            elif found is not None and found.trigger is not None:
                self.fire(found.trigger, found.reason)

    def _find_trigger(self, sample: DiodeReading, beam: Beam, motor_rad: Floats) -> Finding | None:
        if self.mode is Mode.ACQUISITION:
            has_light = beam.state is not BeamState.LOST
            return self.search.evaluate(has_light, motor_rad, sample.time_s)
        return self._follow(beam) if self.mode in BEAM_FOLLOWING else None

    def _follow(self, beam: Beam) -> Finding | None:
        """Whether a beam that is followed is still there, and near the centre."""
        acquisition = self.settings.acquisition
        error = self._error_arcsec(beam) / self.settings.requirement_arcsec
        lost, measured = beam.state is BeamState.LOST, beam.state is BeamState.MEASURED
        count_sample(self, lost, measured, error, IN_REACH, OUT_OF_REACH)
        if self.lost >= acquisition.lost_frames:
            return Finding(Trigger.BEAM_LOST, f"no beam on {self.lost} samples in a row")
        if self.mode is Mode.COARSE and self.in_reach >= acquisition.found_frames:
            return Finding(Trigger.IN_REACH, "the beam is near the centre of the photodiodes")
        if self.mode is Mode.LOCKED and self.out_of_reach >= acquisition.lost_frames:
            state = beam.state.name.lower()
            return Finding(Trigger.OUT_OF_REACH, f"the beam is {state}, and not near the centre")
        return None

    def _error_arcsec(self, beam: Beam) -> float:
        error_m = max(abs(beam.az_m), abs(beam.el_m))
        return error_m / self.settings.sensor.link_length_m * ARCSEC_PER_RAD

    # ------------------------------------------------------------ modes

    def _enter(self, source: Mode, motor_rad: Floats) -> None:
        self.lost = self.in_reach = self.out_of_reach = 0
        super()._enter(source, motor_rad)
        if self.mode is Mode.ACQUISITION:
            asked, self._asked = self._asked, Acquire()
            self.search.start_as_asked(asked, motor_rad, again=source in BEAM_FOLLOWING)
        elif self.mode is Mode.LOCKED:
            self.hold.begin()

    def configure_search(self, asked: Acquire) -> None:
        """How the next search, and no other, is to be made, as a command asks that was not refused."""
        self._asked = asked

    # ------------------------------------------------------------ control laws

    def _search(self, sensed: _Sensed, duration_s: float) -> None:
        position_rad = sensed.servo.position_rad
        self.siderostat.move_to(self.search.advance_from(position_rad, position_rad, duration_s))

    def _pull_in(self, sensed: _Sensed, duration_s: float) -> None:
        error_rad = self._error_rad(sensed.beam)
        if error_rad is not None:
            step_rad = self.hold.pull_in(error_rad, duration_s)
            # No faster than the siderostat follows, or the set-point would run away from it.
            self._turn_beam(limited(step_rad, self._pull_in_rad_s * duration_s))

    def _hold_beam(self, sensed: _Sensed, duration_s: float) -> None:
        error_rad = self._error_rad(sensed.beam)
        if error_rad is not None:
            # What is farther off ends the hold. Until then it counts no more than what would not: a photodiode
            # that comes loose drives neither this siderostat nor that of a stellar loop to its travel's end.
            error_rad = limited(error_rad, self._hold_most_rad)
        self._turn_beam(self.hold.step(error_rad, duration_s))
        if self.siderostat.wanted_fraction > 1.0:
            self.hold.begin()  # at its travel's end it does not turn the beam, and learns no rate

    def _error_rad(self, beam: Beam | None) -> Floats | None:
        if beam is None or beam.state is BeamState.LOST:
            return None
        return beam.place_m / self.settings.sensor.link_length_m

    def _turn_beam(self, step_rad: Floats) -> None:
        # The siderostat's axes may be turned from the photodiodes'.
        self.siderostat.move_by(step_rad.dot(self._turn) / self._motor_sky)

    # ------------------------------------------------------------ for the supervisor

    def begin(self, stack_v: Floats | None) -> None:
        """Begin anew: from now on the photodiodes are sampled."""
        super().begin(stack_v)
        self._photodiode_error = None
        if self.servo.encoders_jumped:
            self.servo.encoders_jumped = False
            self.zeros_lost += 1
            self.search.forget()
        recalled, self._recalled = self._recalled, None
        if recalled is not None and self.search.unfound_rad is not None:
            self._journal.record(msgspec.structs.replace(recalled, time_s=self._clock.now_s()))
            self._report_event(
                "info",
                "the place of the search for the beam is known from before the supervisor was killed; acquire "
                "goes back there",
            )
        self._sampled_s, self._ticked_s = self._clock.now_s(), math.nan
        self._ready = True

    @property
    def place(self) -> BeamPlace | None:
        """Where the next search begins; None if that is where the siderostat stands."""
        unfound_rad = self.search.unfound_rad
        if unfound_rad is None or self.servo.encoders_jumped:
            return None
        search_az_rad, search_el_rad = unfound_rad.tolist()
        az_rad, el_rad = self.servo.position_rad.tolist()
        return BeamPlace(
            time_s=self._clock.now_s(),
            loop=self.name,
            search_az_rad=search_az_rad,
            search_el_rad=search_el_rad,
            siderostat_az_rad=az_rad,
            siderostat_el_rad=el_rad,
        )

    def recall(self, place: BeamPlace) -> None:
        """Search for the beam where a supervisor that was killed did."""
        self._recalled = place
        self.servo.recall((place.siderostat_az_rad, place.siderostat_el_rad))
        self.search.unfound_rad = np.array([place.search_az_rad, place.search_el_rad])

    def jog(self, step_sky_arcsec: Floats) -> None:
        """Turn the siderostat by hand; the next search begins there."""
        super().jog(step_sky_arcsec)
        self.search.forget()

    def release(self) -> None:
        """Ask for no more samples."""
        self._ready = False

    @property
    def servo_state(self) -> ServoState:
        """The siderostat's servo as the newest tick read it."""
        return self._sensed.servo

    @property
    def sampled(self) -> bool:
        """Samples are asked for."""
        return self._ready

    def state(self, now_s: float) -> LoopState:
        """The newest of everything, for consoles."""
        mode, requirement_arcsec = self.mode, self.settings.requirement_arcsec
        searching = mode is Mode.ACQUISITION
        arcsec_per_rad = self._motor_sky * ARCSEC_PER_RAD
        centre_az, centre_el = (self.search.centre_rad * arcsec_per_rad).tolist()
        return LoopState(
            name=self.name,
            mode=mode.name,
            since_s=self.mode_since_s,
            requirement_px=requirement_arcsec / self._sky_arcsec_per_px,
            sky_arcsec_per_px=self._sky_arcsec_per_px,
            usable_commands=[trigger.name.capitalize() for trigger in self.usable_commands],
            last_change=self.last_change,
            interlocks=list(self.interlocks.tripped),
            limits=self._limits,
            watched=self.interlocks.watched(now_s, self.quantities.readings),
            search_centre_sky_arcsec=(centre_az, centre_el) if searching else None,
            search_again=self.search.state_again(self.mode_since_s) if searching else None,
            kind="metrology",
        )

    def tick_record(self) -> MetrologyTick:
        """What the tick was decided by, and what it did."""
        sensed, frame = self._sensed, self._sensed.frame
        sample, beam = sensed.sample or _NO_SAMPLE, sensed.beam or _NO_BEAM
        read_s, (encoder_az_rad, encoder_el_rad), *_ = sensed.servo.reading or NO_READING
        arcsec_per_m = ARCSEC_PER_RAD / self.settings.sensor.link_length_m
        arcsec_per_rad = self._motor_sky * ARCSEC_PER_RAD
        rate_az_rad_s, rate_el_rad_s = self.hold.rate_rad_s.tolist()
        motor_az_rad, motor_el_rad = sensed.motor_rad.tolist()
        setpoint_az_rad, setpoint_el_rad = self.siderostat.setpoint_rad.tolist()
        az_plus_v, az_minus_v, el_plus_v, el_minus_v = sample.volts
        compute_s = self._done_s - sensed.begun_s
        age_s = math.nan if frame is None else frame.received_s - frame.mid_exposure_s
        late = frame is not None and self._done_s - frame.mid_exposure_s > self._late_s
        self.quantities.record_tick(compute_s, self._done_s)
        return MetrologyTick(
            time_s=self._done_s,
            loop=self.name,
            number=-1 if frame is None else frame.number,
            mode=self.mode.name,
            mode_number=int(self.mode),
            frame_age_s=age_s,
            compute_s=compute_s,
            late=late,
            frames_lost=sensed.frames_lost,
            sampled_s=sample.time_s,
            beam_state="" if sensed.beam is None else beam.state.name,
            beam_az_m=beam.az_m,
            beam_el_m=beam.el_m,
            beam_az_arcsec=arcsec_per_m * beam.az_m,
            beam_el_arcsec=arcsec_per_m * beam.el_m,
            noise_az_arcsec=arcsec_per_m * beam.noise_az_m,
            noise_el_arcsec=arcsec_per_m * beam.noise_el_m,
            diode_az_plus_v=az_plus_v,
            diode_az_minus_v=az_minus_v,
            diode_el_plus_v=el_plus_v,
            diode_el_minus_v=el_minus_v,
            rate_az_arcsec_s=ARCSEC_PER_RAD * rate_az_rad_s,
            rate_el_arcsec_s=ARCSEC_PER_RAD * rate_el_rad_s,
            siderostat_az_rad=motor_az_rad,
            siderostat_el_rad=motor_el_rad,
            siderostat_setpoint_az_rad=setpoint_az_rad,
            siderostat_setpoint_el_rad=setpoint_el_rad,
            siderostat_az_sky_arcsec=motor_az_rad * arcsec_per_rad,
            siderostat_el_sky_arcsec=motor_el_rad * arcsec_per_rad,
            search_progress=self.search.progress if self.mode is Mode.ACQUISITION else math.nan,
            amplifier_round_trip_s=sensed.servo.round_trip_s,
            following_error_rad=sensed.servo.following_rad,
            encoder_read_s=read_s,
            encoder_az_rad=encoder_az_rad,
            encoder_el_rad=encoder_el_rad,
            sense_s=self._sensed_s - sensed.begun_s,
            decide_s=self._decided_s - self._sensed_s,
            requested_s=self._requested_s,
        )


def limited(both: Floats, most: float) -> Floats:
    """A pair, shape (2,), in the same direction, with no axis above `most`."""
    return both * min(1.0, most / max(np.abs(both).max(), 1e-12))


def hold_most_rad(settings: MetrologySettings) -> float:
    """The largest error of the beam by which it is held."""
    return OUT_OF_REACH * settings.requirement_arcsec / ARCSEC_PER_RAD


def metrology_loop(name: str, rig: Rig, devices: LoopDevices, journal: Journal) -> MetrologyLoop:
    """A metrology loop on its devices.

    Raises
    ------
    ValueError
        If there are no photodiodes among them.
    """
    if devices.photodiodes is None:
        msg = f"loop {name}: a metrology loop needs the A/D converter of its photodiodes"
        raise ValueError(msg)
    servo = SiderostatServo(
        name, rig.loops[name], devices.amplifiers, journal.clock, rig.camera.period_s
    )
    return MetrologyLoop(name, rig, SiderostatStage(rig, name, servo), devices.photodiodes, journal)


def metrology_limits(rig: Rig, name: str) -> LoopLimits:
    """How far the loop's stages go, and what its search does."""
    loop = rig.metrology_loops[name]
    pitch_px = plan_beam_spiral(rig, name).pitch_px
    return LoopLimits(
        fsm_range_rad=0.0,
        siderostat_travel_sky_arcsec=loop.siderostat.travel_sky_arcsec,
        search_radius_sky_arcsec=loop.acquisition.search_radius_sky_arcsec,
        spiral_pitch_sky_arcsec=pitch_px / sky_px_per_rad(rig) * ARCSEC_PER_RAD,
    )
