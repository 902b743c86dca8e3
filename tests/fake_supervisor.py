"""A supervisor that never was: deterministic telemetry of a plausible scenario.

Times are fixed: the monotonic clock reads `START_S` at the first message, wall time is a winter night.
"""

from __future__ import annotations

import numpy as np

from fitctl.logging.records import (
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    Losses,
    ModeChange,
    PiezoReading,
    RecorderStatus,
    Tick,
)
from fitctl.messages.commands import SequenceStatus
from fitctl.messages.telemetry import (
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
WITH_STAR = {"COARSE", "VERNIER", "EXPERIMENT"}
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
    ("star_lost", "star_flux_fraction", 0.98, 0.05, None, "warn", WITH_STAR),
    ("fsm_edge", "fsm_range_fraction", 0.31, None, 0.9, "warn", {"VERNIER"}),
    ("following_error", "following_error_rad", 0.012, None, 0.5, "safe", set(MODE_NUMBERS)),
    ("amplifier_slow", "amplifier_round_trip_periods", 0.21, None, 1.0, "warn", set(MODE_NUMBERS)),
    ("dac_slow", "dac_round_trip_s", 0.0011, None, 0.005, "warn", set(MODE_NUMBERS)),
    ("frame_age", "frame_late_s", 0.0004, None, 0.01, "warn", set(MODE_NUMBERS)),
    ("disk_space", "disk_free_bytes", 8.1e10, 1e9, None, "warn", set(MODE_NUMBERS)),
    ("piezo_limit", "piezo_limit_error_v", float("nan"), -1.0, 1.0, "safe", set()),
)
USABLE = {
    "OFF": ["Standby"],
    "STANDBY": ["Acquire", "Off"],
    "ACQUISITION": ["Hold"],
    "COARSE": ["Hold"],
    "VERNIER": ["Hold"],
    "SAFE": ["Recover", "Off"],
    "EXPERIMENT": ["Hold"],
}


def spot_image(rng: np.random.Generator, spots: list[tuple[float, float, float]]) -> np.ndarray:
    """A frame with Gaussian spots, each az px, el px, whole flux in DN; shape (40, 40)."""
    el, az = np.mgrid[0:SIZE_PX, 0:SIZE_PX]
    image = BIAS_DN + NOISE_DN * rng.standard_normal((SIZE_PX, SIZE_PX))
    for spot_az, spot_el, flux in spots:
        distance2 = (az - spot_az) ** 2 + (el - spot_el) ** 2
        peak = flux / (2 * np.pi * SPOT_SIGMA_PX**2)
        image += peak * np.exp(-distance2 / (2 * SPOT_SIGMA_PX**2))
    return np.clip(image, 0, 65535).astype("<u2")


class FakeSupervisor:
    """Makes one telemetry message after another.

    In VERNIER the error is a first-order Gauss-Markov process of `error_px` RMS with a correlation of
    0.2 s about zero; the mirror carries a slow drift. In ACQUISITION there is no star yet.
    """

    def __init__(
        self,
        mode: str = "VERNIER",
        *,
        loops: tuple[str, ...] = ("right",),
        error_px: float = 0.034,
        seed: int = 7,
        pid: int = 4242,
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
        self.trigger = "IN_REACH"
        self.reason = "5 frames within 50 % of the range"
        self.bias_offset_urad = (0.0, 0.0)
        self.controller_file = ""
        self.search_again: SearchAgain | None = None
        self.last_failure: LoopFailure | None = None

    @property
    def time_s(self) -> float:
        return START_S + self.number * FRAME_S

    def messages(self, count: int) -> list[Telemetry]:
        return [self.message() for _ in range(count)]

    def message(self) -> Telemetry:
        """The next message: all ticks of `MESSAGE_S`, events and changes in the very first one."""
        first = self.sequence == 0
        self.sequence += 1
        ticks: list[Tick] = []
        while self.time_s <= START_S + self.sequence * MESSAGE_S:
            ticks += [self._tick(loop) for loop in self.loops]
            self.number += 1
        now_s = ticks[-1].time_s
        return Telemetry(
            sequence=self.sequence,
            time_s=now_s,
            wall_minus_monotonic_s=WALL_MINUS_MONOTONIC_S,
            rig_name="fit-mock",
            pid=self.pid,
            loops=[self._state(loop) for loop in self.loops],
            ticks=ticks,
            events=_events() if first else [],
            mode_changes=[self._change(loop) for loop in self.loops] if first else [],
            frame=self._frame(now_s),
            devices=self._devices(),
            piezo=[_piezo(loop, now_s) for loop in self.loops],
            timing=[_timing(loop, now_s) for loop in self.loops],
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
        )

    def _state(self, loop: str) -> LoopState:
        return LoopState(
            name=loop,
            mode=self.mode,
            since_s=START_S - 133.0,
            requirement_px=0.1,
            usable_commands=["Stop", *USABLE[self.mode]],
            sky_arcsec_per_px=2.708,
            controller="minimum-variance",
            last_change=self._change(loop),
            interlocks=self.interlocks,
            limits=LIMITS,
            watched=[self._watched(*row) for row in WATCHED],
            bias_offset_urad=self.bias_offset_urad,
            search_centre_sky_arcsec=(100.0, -40.0) if self.mode == "ACQUISITION" else None,
            other_spots=[SpotPlace(name="fringe", az_offset_px=-12.0, el_offset_px=0.0)],
            controller_file=self.controller_file,
            search_again=self.search_again,
            last_failure=self.last_failure,
        )

    def _watched(self, name, quantity, value, low, high, action, modes) -> Watched:
        return Watched(
            name=name,
            quantity=quantity,
            value=value,
            age_s=float("nan") if np.isnan(value) else 0.01,
            low=low,
            high=high,
            stale_s=1.0,
            action=action,
            judged=self.mode in modes,
        )

    def _siderostat_arcsec(self) -> tuple[float, float]:
        """At rest, or on its spiral about the search's centre."""
        if self.mode != "ACQUISITION":
            return 123.4, -54.8
        turns = self.number * FRAME_S / SPIRAL_S
        radius = LIMITS.spiral_pitch_sky_arcsec * turns
        angle = 2 * np.pi * turns
        return 100.0 + radius * float(np.cos(angle)), -40.0 + radius * float(np.sin(angle))

    def _change(self, loop: str) -> ModeChange:
        modes = list(MODE_NUMBERS)
        source = modes[max(0, modes.index(self.mode) - 1)]
        return ModeChange(
            time_s=START_S - 133.0,
            loop=loop,
            source=source,
            target=self.mode,
            target_number=MODE_NUMBERS[self.mode],
            trigger=self.trigger,
            reason=self.reason,
        )

    def _tick(self, loop: str) -> Tick:
        seen = self.mode in WITH_STAR
        memory = np.exp(-FRAME_S / 0.2)
        kick = self.error_px * np.sqrt(1 - memory**2)
        self.error[loop] = memory * self.error[loop] + kick * self.rng.standard_normal(2)
        error_az, error_el = self.error[loop] if seen else (np.nan, np.nan)
        star_az, star_el = TARGET_PX[0] - error_az, TARGET_PX[1] - error_el
        sky_az, sky_el = self._siderostat_arcsec()
        took_s = 1.8e-4 + 1e-5 * float(self.jitter.exponential(3.0))
        phase = self.number * FRAME_S / 7
        fsm_az, fsm_el = 5e-5 * np.sin(phase), 3e-5 * np.cos(1.3 * phase)
        return Tick(
            time_s=self.time_s,
            loop=loop,
            number=self.number,
            mode=self.mode,
            mode_number=MODE_NUMBERS[self.mode],
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
            window_az_px=round(star_az) if seen else 20,
            window_el_px=round(star_el) if seen else 20,
            target_az_px=TARGET_PX[0],
            target_el_px=TARGET_PX[1],
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
            search_progress=0.37 if self.mode == "ACQUISITION" else float("nan"),
            sense_s=6e-5,
            decide_s=5e-5,
        )

    def _frame(self, now_s: float) -> FrameRecord:
        error_az, error_el = self.error[self.loops[0]]
        star = (TARGET_PX[0] - error_az, TARGET_PX[1] - error_el, 28000.0)
        fringe = (star[0] - 12, star[1], 11000.0)
        seen = self.mode in WITH_STAR
        image = spot_image(self.rng, [star, fringe] if seen else [])
        return FrameRecord(
            time_s=now_s - 0.035,
            camera="camera",
            number=self.number,
            width_px=SIZE_PX,
            height_px=SIZE_PX,
            data=image.tobytes(),
        )

    def _devices(self) -> list[DeviceHealth]:
        known = {"camera": ("127.0.0.1:3956", "FIT mock camera 1.0", "50.0 Hz, no packet lost")}
        for loop in self.loops:
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


def _events() -> list[Event]:
    return [
        Event(
            time_s=START_S - 141.0,
            severity="info",
            source="supervisor",
            message="all devices enabled",
        ),
        Event(
            time_s=START_S - 140.2,
            severity="warning",
            source="camera",
            message="1 packet resent in frame 208",
        ),
        Event(
            time_s=START_S - 136.5,
            severity="info",
            source="right",
            message="star found at 31.20, 8.75 px, 27 900 DN",
        ),
        Event(
            time_s=START_S - 133.0,
            severity="info",
            source="right",
            message="handed over to the mirror after 3.5 s",
        ),
    ]
