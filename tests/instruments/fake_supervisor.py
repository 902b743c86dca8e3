"""A supervisor that never was: deterministic telemetry of states that can be.

What is NaN and which commands can be used is as the simulated supervisor has it in each mode;
`tests/tui/test_states_that_can_be.py` compares both. Times are fixed: the monotonic clock reads `START_S` at
the first message, wall time is a winter night.
"""

from __future__ import annotations

import functools
import pickle

import numpy as np

from fitctl.logging.records import (
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    Losses,
    MetrologyTick,
    ModeChange,
    Overlap,
    PiezoReading,
    RecorderStatus,
    Tick,
)
from fitctl.messages.commands import SequenceStatus
from fitctl.messages.telemetry import (
    CollectorState,
    FringeOptics,
    LearningState,
    LoopFailure,
    LoopLimits,
    LoopState,
    SearchAgain,
    SpotPlace,
    Telemetry,
    TrippedInterlock,
    Watched,
)

START_S = 1000.0
WALL_MINUS_MONOTONIC_S = 1796021000.0
MESSAGE_S = 0.05
FRAME_S = 0.02
SIZE_PX = 40
BIAS_DN = 1000.0
NOISE_DN = 20.0
SPOT_SIGMA_PX = 0.75
TARGET_PX = (24.0, 19.5)
MODE_NUMBERS = {
    "OFF": 0,
    "STANDBY": 1,
    "ACQUISITION": 2,
    "COARSE": 3,
    "VERNIER": 4,
    "SAFE": 5,
    "EXPERIMENT": 6,
}
NUMBERS = MODE_NUMBERS | {"LOCKED": 7}
WITH_STAR = {
    "COARSE",
    "VERNIER",
    "EXPERIMENT",
    "SAFE",
}  # a window is measured until the mode after SAFE
FOLLOWING = WITH_STAR - {"SAFE"}
POWERED = {"STANDBY", "ACQUISITION", *FOLLOWING}
# What leads to each mode, from where, and the reason in the supervisor's words.
CHANGES = {
    "STANDBY": ("OFF", "STANDBY", "all devices open, checked and enabled"),
    "ACQUISITION": ("STANDBY", "ACQUIRE", "operator"),
    "COARSE": ("ACQUISITION", "STAR_FOUND", "star on 3 frames in a row"),
    "VERNIER": ("COARSE", "IN_REACH", "the mirror needs 4% of its range"),
    "LOCKED": ("COARSE", "IN_REACH", "beam near the centre on 5 samples in a row"),
    "SAFE": ("VERNIER", "STOP", "operator"),
    "EXPERIMENT": ("VERNIER", "EXPERIMENT", "operator"),
}
# How far the star is from its target where no mirror holds it, in px.
STANDING_PX = {"COARSE": (-4.4, 1.2), "SAFE": (-0.2, -0.12)}
TESTBED = ("right", "metrology", "left")
TESTBED_TARGETS_PX = {"right": (28.0, 20.0), "left": (12.0, 20.0)}
LIMITS = LoopLimits(
    fsm_range_rad=1.772e-4,
    siderostat_travel_sky_arcsec=600.0,
    search_radius_sky_arcsec=215.0,
    spiral_pitch_sky_arcsec=50.0,
)
SPIRAL_S = 8.0
STAR_LOST = SearchAgain(
    since_s=START_S - 133.0, round_number=2, radius_sky_arcsec=107.5, pauses=False, limit_s=None
)
# A few rows of the shipped table of interlocks: name, quantity, reading, low, high, action, in which modes.
WATCHED = (
    ("star_lost", "star_flux_fraction", 0.98, 0.05, None, "warn", FOLLOWING),
    ("fsm_edge", "fsm_range_fraction", 0.31, None, 0.9, "warn", {"VERNIER"}),
    ("following_error", "following_error_rad", 0.012, None, 0.5, "safe", POWERED),
    ("amplifier_slow", "amplifier_round_trip_periods", 0.21, None, 1.0, "warn", POWERED),
    ("dac_slow", "dac_round_trip_s", 0.0011, None, 0.005, "warn", POWERED),
    ("frame_age", "frame_late_s", 0.0004, None, 0.01, "warn", FOLLOWING),
    ("disk_space", "disk_free_bytes", 8.1e10, 1e9, None, "warn", set(MODE_NUMBERS)),
    ("piezo_limit", "piezo_limit_error_v", float("nan"), -1.0, 1.0, "safe", POWERED),
)
USABLE = {
    "OFF": ["Standby"],
    "STANDBY": ["Acquire", "Off"],
    "ACQUISITION": ["Acquire", "Release"],
    "COARSE": ["Release"],
    "VERNIER": ["Release"],
    "SAFE": ["Recover", "Off"],
    "EXPERIMENT": ["Release"],
    "LOCKED": ["Release"],
}

_EL_PX, _AZ_PX = np.mgrid[0:SIZE_PX, 0:SIZE_PX]


def spot_image(rng: np.random.Generator, spots: list[tuple[float, float, float]]) -> np.ndarray:
    """A frame with Gaussian spots, each az px, el px, whole flux in DN; shape (40, 40)."""
    image = BIAS_DN + NOISE_DN * rng.standard_normal((SIZE_PX, SIZE_PX))
    for spot_az, spot_el, flux in spots:
        distance2 = (_AZ_PX - spot_az) ** 2 + (_EL_PX - spot_el) ** 2
        peak = flux / (2 * np.pi * SPOT_SIGMA_PX**2)
        image += peak * np.exp(-distance2 / (2 * SPOT_SIGMA_PX**2))
    return np.clip(image, 0, 65535).astype("<u2")


class FakeSupervisor:
    """Makes one telemetry message after another.

    In VERNIER the error is a first-order Gauss-Markov process of `error_px` RMS with a correlation of
    0.2 s about zero; the mirror carries a slow drift. In COARSE and SAFE the star stands beside its target,
    in ACQUISITION and STANDBY none is measured, and in OFF there are neither ticks nor frames. A loop that
    is named "metrology" is one; `modes` names those loops that are in another mode than `mode`.
    """

    def __init__(
        self,
        mode: str = "VERNIER",
        *,
        loops: tuple[str, ...] = ("right",),
        error_px: float = 0.034,
        seed: int = 7,
        pid: int = 4242,
        modes: dict[str, str] | None = None,
    ) -> None:
        self.mode = mode
        self.loops = loops
        self.error_px = error_px
        self.pid = pid
        self.rng = np.random.default_rng(seed)
        self.jitter = np.random.default_rng(seed + 1)
        self.error = {loop: error_px * self.rng.standard_normal(2) for loop in loops}
        self.number = 0
        self.sequence = 0
        self.faulty: dict[str, str] = {}
        self.records_lost = 0
        self.ticks_unsent = 0
        self.interlocks: list[TrippedInterlock] = []
        self.running_sequence: SequenceStatus | None = None
        self.modes = modes or {}
        self.trigger = ""  # what led to the mode, and why; empty as `CHANGES` has it
        self.reason = ""
        self.stopped_by = "anna"
        self.waits_for: dict[str, str] = {}
        self.learning: LearningState | None = None
        self.bias_offset_urad = (0.0, 0.0)
        self.controller = "minimum-variance"
        self.controller_file = ""
        self.noise_px: float | None = None
        self.search_again: SearchAgain | None = None
        self.last_failure: LoopFailure | None = None

    @property
    def time_s(self) -> float:
        return START_S + self.number * FRAME_S

    def mode_of(self, loop: str) -> str:
        """A metrology loop that holds its beam is in LOCKED."""
        mode = self.modes.get(loop, self.mode)
        return "LOCKED" if loop == "metrology" and mode in {"VERNIER", "EXPERIMENT"} else mode

    def target_px(self, loop: str) -> tuple[float, float]:
        return TESTBED_TARGETS_PX[loop] if self.is_testbed else TARGET_PX

    @property
    def is_testbed(self) -> bool:
        return "metrology" in self.loops

    @property
    def stars(self) -> list[str]:
        return [loop for loop in self.loops if loop != "metrology"]

    def messages(self, count: int) -> list[Telemetry]:
        """Made once for supervisors in the same state: most tests of the console begin with the same."""
        messages, left = _made(type(self), pickle.dumps(vars(self)), count)
        vars(self).update(pickle.loads(left))
        return list(messages)

    def message(self) -> Telemetry:
        """The next message: all ticks of `MESSAGE_S`, events and changes in the very first one."""
        first = self.sequence == 0
        self.sequence += 1
        ticks: list[Tick] = []
        beams: list[MetrologyTick] = []
        overlaps: list[Overlap] = []
        now_s = self.time_s
        while self.time_s <= START_S + self.sequence * MESSAGE_S:
            now_s = self.time_s
            ticking = [loop for loop in self.loops if self.mode_of(loop) != "OFF"]
            ticks += [self._tick(loop) for loop in ticking if loop != "metrology"]
            beams += [self._beam(loop) for loop in ticking if loop == "metrology"]
            overlaps += [self._overlap()] if self.loops == TESTBED else []
            self.number += 1
        all_off = {self.mode_of(loop) for loop in self.loops} == {"OFF"}
        return Telemetry(
            sequence=self.sequence,
            time_s=now_s,
            wall_minus_monotonic_s=WALL_MINUS_MONOTONIC_S,
            rig_name="fit-testbed" if self.is_testbed else "fit-mock",
            pid=self.pid,
            loops=[self._state(loop) for loop in self.loops],
            ticks=ticks,
            events=self._events() if first else [],
            mode_changes=[change for loop in self.loops if (change := self._change(loop))]
            if first
            else [],
            frame=None if all_off else self._frame(now_s),
            devices=[] if all_off else self._devices(),
            piezo=[] if all_off else [_piezo(loop, now_s) for loop in self.stars],
            timing=[] if all_off else [_timing(loop, now_s) for loop in self.loops],
            recorder=RecorderStatus(
                time_s=now_s,
                path="logs/fit-mock-20261130T031500Z.mcap",
                records=60 * self.number,
                lost=0,
                bytes_written=9000 * self.number,
            ),
            losses=Losses(
                time_s=now_s,
                records_offered=60 * self.number,
                records_lost=self.records_lost,
                ticks_unsent=self.ticks_unsent,
                events_unsent=0,
                mode_changes_unsent=0,
                replies_unsent=0,
            ),
            scheduling="SCHED_OTHER: real-time priority not permitted",
            running_sequence=self.running_sequence,
            stopped_by=self.stopped_by if "SAFE" in map(self.mode_of, self.loops) else "",
            metrology_ticks=beams,
            overlaps=overlaps,
            fringes=FringeOptics(loops=("left", "right"), aperture_m=0.15, wavelength_m=700e-9)
            if self.is_testbed
            else None,
            collector=CollectorState(busy=False, motion="drift", az_mm=0.3, el_mm=0.0, error="")
            if self.is_testbed
            else None,
        )

    def _state(self, loop: str) -> LoopState:
        mode, is_beam = self.mode_of(loop), loop == "metrology"
        return LoopState(
            name=loop,
            mode=mode,
            since_s=START_S - 133.0,
            requirement_px=1.0 / 2.708 if is_beam else 0.1,
            usable_commands=["Stop", *USABLE[mode]],
            sky_arcsec_per_px=2.708,
            controller="" if is_beam else self.controller,
            last_change=self._change(loop),
            interlocks=self.interlocks,
            limits=LIMITS,
            watched=[self._watched(mode, *row) for row in WATCHED],
            bias_offset_urad=self.bias_offset_urad,
            search_centre_sky_arcsec=(100.0, -40.0) if mode == "ACQUISITION" else None,
            other_spots=[] if is_beam else [self._fringe(loop)],
            controller_file=self.controller_file,
            noise_px=self.noise_px,
            search_again=self.search_again if mode == "ACQUISITION" else None,
            last_failure=self.last_failure,
            kind="metrology" if is_beam else "stellar",
            waits_for=self.waits_for.get(loop, ""),
            learning=None if is_beam else self.learning,
        )

    def _fringe(self, loop: str) -> SpotPlace:
        """Of both loops of the testbed it is at the same place; 8 px to the left of the right star."""
        az_offset_px = {"right": -8.0, "left": 8.0}[loop] if self.is_testbed else -12.0
        return SpotPlace(name="fringe", az_offset_px=az_offset_px, el_offset_px=0.0)

    def _watched(self, mode, name, quantity, value, low, high, action, modes) -> Watched:
        return Watched(
            name=name,
            quantity=quantity,
            value=value,
            age_s=float("nan") if np.isnan(value) else 0.01,
            low=low,
            high=high,
            stale_s=1.0,
            action=action,
            judged=mode in modes,
        )

    def _siderostat_arcsec(self, mode: str) -> tuple[float, float]:
        """At rest, or on its spiral about the search's centre."""
        if mode != "ACQUISITION":
            return 123.4, -54.8
        turns = self.number * FRAME_S / SPIRAL_S
        radius = LIMITS.spiral_pitch_sky_arcsec * turns
        angle = 2 * np.pi * turns
        return 100.0 + radius * float(np.cos(angle)), -40.0 + radius * float(np.sin(angle))

    def _change(self, loop: str) -> ModeChange | None:
        mode = self.mode_of(loop)
        if mode not in CHANGES:
            return None
        source, trigger, reason = CHANGES[mode]
        source = "VERNIER" if self.trigger == "STAR_LOST" else source
        if loop == "metrology":
            source = "LOCKED" if source == "VERNIER" else source
            trigger = "BEAM_FOUND" if trigger == "STAR_FOUND" else trigger
            reason = reason.replace("star on 3 frames", "beam on 3 samples")
        return ModeChange(
            time_s=START_S - 133.0,
            loop=loop,
            source=source,
            target=mode,
            target_number=NUMBERS[mode],
            trigger=(loop not in self.modes and self.trigger) or trigger,
            reason=(loop not in self.modes and self.reason) or reason,
        )

    def _tick(self, loop: str) -> Tick:
        mode = self.mode_of(loop)
        seen, target_px = mode in WITH_STAR, self.target_px(loop)
        memory = np.exp(-FRAME_S / 0.2)
        kick = self.error_px * np.sqrt(1 - memory**2)
        self.error[loop] = memory * self.error[loop] + kick * self.rng.standard_normal(2)
        error_az, error_el = self.error[loop] + STANDING_PX.get(mode, 0.0)
        if not seen:
            error_az = error_el = np.nan
        star_az, star_el = target_px[0] - error_az, target_px[1] - error_el
        sky_az, sky_el = self._siderostat_arcsec(mode)
        took_s = 1.8e-4 + 1e-5 * float(self.jitter.exponential(3.0))
        phase = self.number * FRAME_S / 7
        held = (
            1.0 if mode in {"VERNIER", "EXPERIMENT"} else 0.0
        )  # in other modes the mirror is at its bias
        fsm_az, fsm_el = held * 5e-5 * np.sin(phase), held * 3e-5 * np.cos(1.3 * phase)
        return Tick(
            time_s=self.time_s,
            loop=loop,
            number=self.number,
            mode=mode,
            mode_number=NUMBERS[mode],
            mid_exposure_s=self.time_s - 0.035,
            frame_age_s=0.035 + took_s,
            compute_s=took_s,
            late=False,
            frames_lost=0,
            star_visible=seen,
            star_az_px=float(star_az),
            star_el_px=float(star_el),
            star_flux_dn=27900.0 + 100 * float(self.rng.standard_normal())
            if seen
            else float("nan"),
            window_az_px=round(star_az) if seen else -1,
            window_el_px=round(star_el) if seen else -1,
            target_az_px=target_px[0],
            target_el_px=target_px[1],
            error_az_px=float(error_az),
            error_el_px=float(error_el),
            fsm_az_rad=float(fsm_az),
            fsm_el_rad=float(fsm_el),
            fsm_range_fraction=float((abs(fsm_az) + abs(fsm_el)) / 1.772e-4),
            fsm_saturated=False,
            stack1_v=5.0 + 2e4 * float(fsm_az),
            stack2_v=5.0 - 2e4 * float(fsm_az),
            stack3_v=5.0 + 2e4 * float(fsm_el),
            siderostat_az_rad=21.31,
            siderostat_el_rad=-9.47,
            siderostat_setpoint_az_rad=21.3104,
            siderostat_setpoint_el_rad=-9.4702,
            siderostat_az_sky_arcsec=sky_az,
            siderostat_el_sky_arcsec=sky_el,
            search_progress=0.37 if mode == "ACQUISITION" else float("nan"),
            sense_s=6e-5,
            decide_s=5e-5,
            mirror_az_rad=float(fsm_az),
            mirror_el_rad=float(fsm_el),
        )

    def _beam(self, loop: str) -> MetrologyTick:
        mode = self.mode_of(loop)
        measured = mode in {"COARSE", "LOCKED", "SAFE"}
        noise_az, noise_el = 0.1 * self.jitter.standard_normal(2)
        standing = {"COARSE": 9.0, "SAFE": 0.6}.get(mode, 0.0)
        beam_az, beam_el = (np.nan, np.nan)
        if measured:
            beam_az, beam_el = float(standing + noise_az), float(noise_el)
        sky_az, sky_el = self._siderostat_arcsec(mode)
        light_v = 5.0 + 0.02 * self.jitter.standard_normal(4)
        volts = (light_v if measured else light_v - 5.0).tolist()
        return MetrologyTick(
            time_s=self.time_s,
            loop=loop,
            number=self.number,
            mode=mode,
            mode_number=NUMBERS[mode],
            frame_age_s=0.0352,
            compute_s=1.9e-4,
            late=False,
            frames_lost=0,
            sampled_s=self.time_s - 0.025,
            beam_state="MEASURED" if measured else "LOST",
            beam_az_m=beam_az * 4.85e-5,
            beam_el_m=beam_el * 4.85e-5,
            beam_az_arcsec=beam_az,
            beam_el_arcsec=beam_el,
            noise_az_arcsec=0.05 if measured else float("nan"),
            noise_el_arcsec=0.05 if measured else float("nan"),
            diode_az_plus_v=volts[0],
            diode_az_minus_v=volts[1],
            diode_el_plus_v=volts[2],
            diode_el_minus_v=volts[3],
            rate_az_arcsec_s=0.4 if measured else 0.0,
            rate_el_arcsec_s=-0.2 if measured else 0.0,
            siderostat_az_rad=18.2,
            siderostat_el_rad=-3.1,
            siderostat_setpoint_az_rad=18.2002,
            siderostat_setpoint_el_rad=-3.1001,
            siderostat_az_sky_arcsec=sky_az,
            siderostat_el_sky_arcsec=sky_el,
            search_progress=0.37 if mode == "ACQUISITION" else float("nan"),
            amplifier_round_trip_s=4e-4,
            following_error_rad=0.011,
            encoder_read_s=self.time_s - 0.002,
            encoder_az_rad=18.2,
            encoder_el_rad=-3.1,
            sense_s=6e-5,
            decide_s=5e-5,
        )

    def _overlap(self) -> Overlap:
        """Both stars' errors against each other; the visibility about as theory has it."""
        followed = {self.mode_of(loop) for loop in self.stars} <= {"COARSE", "VERNIER"}
        left, right = (
            self.error[loop] + STANDING_PX.get(self.mode_of(loop), 0.0)
            for loop in ("left", "right")
        )
        tilt_arcsec = 2.708 * (right - left) if followed else np.full(2, np.nan)
        x = np.pi * 0.15 / 700e-9 * np.hypot(*tilt_arcsec) / 206265
        return Overlap(
            time_s=self.time_s - 0.035,
            loop="left",
            other_loop="right",
            number=self.number,
            tilt_az_arcsec=float(tilt_arcsec[0]),
            tilt_el_arcsec=float(tilt_arcsec[1]),
            visibility=float(np.exp(-(x**2) / 8)),
        )

    def _frame(self, now_s: float) -> FrameRecord:
        spots = []
        for loop in self.stars:
            error = self.error[loop] + STANDING_PX.get(self.mode_of(loop), 0.0)
            star = tuple(np.array(self.target_px(loop)) - error)
            if self.mode_of(loop) in WITH_STAR:
                fringe = (star[0] + self._fringe(loop).az_offset_px, star[1])
                spots += [(*star, 28000.0), (*fringe, 4000.0 if self.is_testbed else 11000.0)]
        image = spot_image(self.rng, spots)
        return FrameRecord(
            time_s=now_s - 0.035,
            camera="camera",
            number=self.number,
            width_px=SIZE_PX,
            height_px=SIZE_PX,
            data=image.tobytes(),
        )

    def _events(self) -> list[Event]:
        """What led to the present mode of each loop, oldest first."""
        opening = Event(
            time_s=START_S - 141.0,
            severity="info",
            source="supervisor",
            message="opening and checking all devices",
        )
        events = [] if {self.mode_of(loop) for loop in self.loops} == {"OFF"} else [opening]
        for loop in self.loops:
            change = self._change(loop)
            path: list[Event] = []
            time_s = START_S - 133.0
            while change is not None:
                fault = change.trigger == "FAULT"
                path.append(
                    Event(
                        time_s=time_s,
                        severity="error" if fault else "info",
                        source=loop,
                        message=f"{change.source} -> {change.target}: {change.reason}",
                    )
                )
                time_s -= 1.5
                before = FakeSupervisor(change.source, loops=(loop,))
                change = before._change(loop)
            events += reversed(path)
        return sorted(events, key=lambda event: event.time_s)

    def _devices(self) -> list[DeviceHealth]:
        known = {"camera": ("127.0.0.1:3956", "FIT mock camera 1.0", "50.0 Hz, no packet lost")}
        if self.is_testbed:
            known["hexapod"] = ("127.0.0.1:50000", "PI C-887.53 mock", "drift")
            known["metrology siderostat"] = (
                "socket://127.0.0.1:29537",
                "FIT mock CiA 402",
                "enabled, both axes",
            )
            known["metrology photodiodes"] = (
                "127.0.0.1:29503",
                "LabJack T7 mock",
                "50 samples a second",
            )
        for loop in self.stars:
            known |= {
                f"{loop} siderostat": (
                    "socket://127.0.0.1:29536",
                    "FIT mock CiA 402",
                    "enabled, both axes",
                ),
                f"{loop} D/A": (
                    "127.0.0.1:29502",
                    "FIT mock Modbus D/A",
                    "1 204 writes, none late",
                ),
                f"{loop} piezo": (
                    "socket://127.0.0.1:29693",
                    "Thorlabs MDT693B 1.05",
                    "limit switch 150 V",
                ),
            }
        return [
            DeviceHealth(
                time_s=self.time_s,
                device=device,
                endpoint=endpoint,
                state="fault" if device in self.faulty else "ok",
                identity=identity,
                detail=self.faulty.get(device, detail),
            )
            for device, (endpoint, identity, detail) in known.items()
        ]


def _piezo(loop: str, now_s: float) -> PiezoReading:
    return PiezoReading(
        time_s=now_s, loop=loop, stack1_v=79.4, stack2_v=70.1, stack3_v=77.2, limit_v=150.5
    )


def _timing(loop: str, now_s: float) -> LoopTiming:
    return LoopTiming(
        time_s=now_s,
        loop=loop,
        ticks=50,
        late_ticks=0,
        frames_lost=0,
        compute_median_s=2.1e-4,
        compute_worst_s=8.4e-4,
        frame_age_median_s=0.0381,
        frame_age_worst_s=0.0412,
        servo_periods=500,
        servo_late_median_s=2.1e-5,
        servo_late_worst_s=1.2e-3,
        servo_missed=0,
        stalls=0,
        worst_stall_s=0.0,
    )


@functools.lru_cache(maxsize=20)
def _made(kind: type[FakeSupervisor], state: bytes, count: int) -> tuple[list[Telemetry], bytes]:
    """The next messages of a supervisor in such a state, and its state after them."""
    supervisor = kind.__new__(kind)
    vars(supervisor).update(pickle.loads(state))
    messages = [supervisor.message() for _ in range(count)]
    return messages, pickle.dumps(vars(supervisor))
