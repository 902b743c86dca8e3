"""What interlocks judge: measured once a tick, or handed in about once a second, into one flat record."""

from __future__ import annotations

import math

from fitctl.config import ARCSEC_PER_RAD, Rig
from fitctl.controllers.photodiodes import Beam, BeamState
from fitctl.drivers.interface import ServoReading
from fitctl.logging.records import LoopTiming, PiezoReading
from fitctl.loop.interlocks import Reading
from fitctl.loop.observation import Observation
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.servo import ServoState
from fitctl.stages.siderostat import SiderostatStage


class Quantities:
    """What every kind of loop measures; the names are those of :data:`fitctl.config.QUANTITIES`.

    Attributes
    ----------
    readings : dict
        The newest of each quantity: value, time in s, note.
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        siderostat = rig.loops[loop_name].siderostat
        self.readings: dict[str, Reading] = {}
        self._period_s = rig.camera.period_s
        self._servo_period_s = 1.0 / siderostat.servo.rate_hz
        self._velocity_limit_rad_s = siderostat.velocity_limit_rad_s
        self._read: ServoReading | None = None

    def put(self, name: str, value: float, time_s: float) -> None:
        """One value; may be called from any thread."""
        self.readings[name] = (value, time_s, "")

    def begin(self) -> None:
        """Devices were opened anew: what was measured before says nothing about what comes now."""
        self._read = None

    def record_siderostat(
        self, servo: ServoState, siderostat: SiderostatStage, now_s: float
    ) -> None:
        """Where the siderostat is, and how its amplifiers are."""
        readings = self.readings
        readings["siderostat_asked_fraction"] = (siderostat.wanted_fraction, now_s, "")
        fault = servo.fault
        # Made a text only when there is something to say.
        readings["amplifier_fault"] = (
            (0.0, now_s, "") if fault is None else (1.0, now_s, str(fault))
        )
        periods = servo.round_trip_s / self._servo_period_s
        readings["amplifier_round_trip_periods"] = (periods, now_s, "")
        if not math.isnan(servo.following_rad):
            readings["following_error_rad"] = (servo.following_rad, now_s, "")
        reading, before = servo.reading, self._read
        if reading is None or reading is before:
            return
        self._read = reading
        az_rad, el_rad = reading.position_rad
        travelled = max(abs(az_rad), abs(el_rad)) / siderostat.travel_rad
        readings["siderostat_travel_fraction"] = (travelled, reading.time_s, "")
        if before is not None and reading.time_s > before.time_s:
            before_az_rad, before_el_rad = before.position_rad
            moved_rad = max(abs(az_rad - before_az_rad), abs(el_rad - before_el_rad))
            rate_rad_s = moved_rad / (reading.time_s - before.time_s)
            readings["siderostat_rate_fraction"] = (
                rate_rad_s / self._velocity_limit_rad_s,
                reading.time_s,
                "",
            )

    def record_tick(self, compute_s: float, now_s: float) -> None:
        """How long the tick took; judged at the next."""
        self.readings["tick_period_fraction"] = (compute_s / self._period_s, now_s, "")

    def record_timing(self, record: LoopTiming) -> None:
        """Whether the servo kept its pace, where it has a pace of its own."""
        periods = record.servo_periods + record.servo_skipped
        if periods:
            self.put("servo_skipped_fraction", record.servo_skipped / periods, record.time_s)


class StellarQuantities(Quantities):
    """One stellar loop's.

    Attributes
    ----------
    star_flux_dn : float
        Of the star that is searched for or held.
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        super().__init__(rig, loop_name)
        loop = rig.stellar_loops[loop_name]
        self._delay_s = rig.camera.frame_delay_s
        self.star_flux_dn = loop.star_flux_dn
        self._range_rad = loop.fsm.range_rad
        self._limit_v = loop.fsm.piezo.limit_v
        self._exposed_s: float | None = None
        self._skipped = 0

    def begin(self) -> None:
        """Devices were opened anew, and the camera with them, perhaps."""
        super().begin()
        self._exposed_s = None

    def record_observation(self, observation: Observation) -> None:
        """What a frame says about camera and star."""
        frame, star, now_s = observation.frame, observation.star, observation.now_s
        if frame is None:
            return
        readings, exposed_s = self.readings, frame.mid_exposure_s
        late_s = frame.received_s - exposed_s - self._delay_s
        readings["frame_late_s"] = (late_s, now_s, "")
        skipped = observation.frames_skipped - self._skipped
        # Fewer than before: the camera was opened anew, for another loop.
        if self._exposed_s is not None and skipped >= 0:
            # Frames that were skipped did come.
            periods = (exposed_s - self._exposed_s) / self._period_s / (1 + skipped)
            readings["frame_interval_periods"] = (periods, now_s, "")
        self._exposed_s, self._skipped = exposed_s, observation.frames_skipped
        if star is not None:
            readings["star_flux_fraction"] = (star.flux_dn / self.star_flux_dn, now_s, "")

    def record_stages(
        self, observation: Observation, siderostat: SiderostatStage, mirror: MirrorStage
    ) -> None:
        """Where mirror and siderostat are, and how their devices are."""
        self._record_mirror(mirror, observation.now_s)
        self.record_siderostat(observation.servo, siderostat, observation.now_s)

    def _record_mirror(self, mirror: MirrorStage, now_s: float) -> None:
        readings = self.readings
        az_rad, el_rad = mirror.command_rad.tolist()
        fraction = (abs(az_rad) + abs(el_rad)) / self._range_rad
        readings["fsm_range_fraction"] = (fraction, now_s, "")
        readings["dac_unwritten_s"] = (now_s - mirror.written_s, now_s, "")
        readings["dac_round_trip_s"] = (mirror.round_trip_s, now_s, "")

    def record_piezo_error(self, error: str, now_s: float) -> None:
        """Whether the piezo amplifier has an error, and what it says."""
        self.readings["piezo_fault"] = (1.0 if error else 0.0, now_s, error)

    def record_piezo(self, record: PiezoReading) -> None:
        """What the piezo amplifier said."""
        self.put("piezo_limit_error_v", record.limit_v - self._limit_v, record.time_s)


class MetrologyQuantities(Quantities):
    """One metrology loop's."""

    def __init__(self, rig: Rig, loop_name: str) -> None:
        super().__init__(rig, loop_name)
        sensor = rig.metrology_loops[loop_name].sensor
        self._on_axis_v = 4 * sensor.on_axis_v
        self._arcsec_per_m = ARCSEC_PER_RAD / sensor.link_length_m

    def record_beam(self, beam: Beam, now_s: float) -> None:
        """What a new sample says about the beam."""
        readings = self.readings
        readings["beam_light_fraction"] = (beam.sum_v / self._on_axis_v, now_s, "")
        saturated = float(beam.state is BeamState.SATURATED)
        readings["diode_saturated"] = (saturated, now_s, "")
        if beam.state is not BeamState.LOST:
            error_arcsec = self._arcsec_per_m * max(abs(beam.az_m), abs(beam.el_m))
            readings["beam_error_arcsec"] = (error_arcsec, now_s, "")

    def record_sample_age(self, age_s: float, now_s: float) -> None:
        """How old the newest sample is."""
        self.readings["diode_sample_age_s"] = (age_s, now_s, "")


def stellar_places(rig: Rig, loop_name: str) -> dict[str, str]:
    """Each part that a stellar loop measures by name and endpoint, as errors of devices call it."""
    loop = rig.stellar_loops[loop_name]
    return _places(rig, loop_name) | {
        "camera": f"camera at {rig.camera.device.endpoint}",
        "mirror": f"mirror {loop_name}",
        "star": f"star of {loop_name}",
        "D/A": f"D/A at {loop.fsm.dac.endpoint}",
        "piezo amplifier": f"piezo amplifier at {loop.fsm.piezo.port}",
    }


def metrology_places(rig: Rig, loop_name: str) -> dict[str, str]:
    """Each part that a metrology loop measures, as :func:`stellar_places`."""
    loop = rig.metrology_loops[loop_name]
    return _places(rig, loop_name) | {
        "beam": f"beam of {loop_name}",
        "photodiodes": f"photodiodes at {loop.sensor.device.endpoint}",
    }


def _places(rig: Rig, loop_name: str) -> dict[str, str]:
    endpoint = rig.loops[loop_name].siderostat.device.endpoint
    return {"siderostat": f"siderostat {loop_name} at {endpoint}", "computer": "computer"}
