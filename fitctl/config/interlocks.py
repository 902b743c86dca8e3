"""The rig file's interlocks: one row a rule, and the quantities that rules may be about."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from fitctl.config.base import Finite, NonNegative, Positive, Settings, require_order

ModeName = Literal[
    "OFF", "STANDBY", "ACQUISITION", "COARSE", "VERNIER", "SAFE", "EXPERIMENT", "LOCKED"
]
RENAMED_ACTIONS = {"hold": "freeze"}
"""Actions of an older fitctl, which are refused with the name of today."""
Action = Literal["warn", "freeze", "flatten", "safe"]
ResetBy = Literal["hand", "itself"]


class Quantity(NamedTuple):
    """Something that is measured: what it is, which part of the rig it is of, and what to do about it."""

    meaning: str
    part: Literal[
        "star",
        "camera",
        "mirror",
        "D/A",
        "piezo amplifier",
        "beam",
        "photodiodes",
        "siderostat",
        "computer",
    ]
    remedy: str
    every_frame: bool = False


QUANTITIES: dict[str, Quantity] = {
    "star_flux_fraction": Quantity(
        "light of the star when last seen, over star_flux_dn",
        "star",
        "look at shutter, clouds, focus and star_flux_dn",
        every_frame=True,
    ),
    "fsm_range_fraction": Quantity(
        "the mirror's way from its middle, |az| + |el| over range_rad",
        "mirror",
        "let the siderostat take over more: see offload_per_s and crossover_hz",
    ),
    "beam_light_fraction": Quantity(
        "light of the metrology beam when last sampled, all photodiodes, over that of a beam on the centre",
        "beam",
        "look at the laser, its path and on_axis_v",
    ),
    "beam_error_arcsec": Quantity(
        "the metrology beam's angle from the centre when last sampled, the larger of the axes",
        "beam",
        "see whether the collector moves faster than the loop follows",
    ),
    "diode_saturated": Quantity(
        "1 while a photodiode is at saturated_v, else 0",
        "photodiodes",
        "dim the laser or the room, or set a larger range_v",
    ),
    "diode_sample_age_s": Quantity(
        "age of the photodiodes' newest sample",
        "photodiodes",
        "look at the A/D converter and its link",
    ),
    "siderostat_asked_fraction": Quantity(
        "the wanted set-point's way from the encoders' zero, before it is limited, over the travel",
        "siderostat",
        "the siderostat waits at its limit; release, then re-point, or look for a wrong star",
    ),
    "siderostat_travel_fraction": Quantity(
        "the motors' way from the encoders' zero, over the travel",
        "siderostat",
        "look at the encoders and their zero",
    ),
    "siderostat_rate_fraction": Quantity(
        "how fast the motors turn by their encoders, over velocity_limit_rad_s",
        "siderostat",
        "cut the motors' power, then look at amplifiers and encoders",
    ),
    "following_error_rad": Quantity(
        "how far the motors stay behind their moving reference, at least, since the last tick",
        "siderostat",
        "look for friction, a weak amplifier or a low gain_per_s",
    ),
    "amplifier_fault": Quantity(
        "1 while the servo has an error of its amplifiers, else 0",
        "siderostat",
        "remove its cause, then recover",
    ),
    "amplifier_round_trip_periods": Quantity(
        "time of the last exchange with the amplifiers, in periods of the servo",
        "siderostat",
        "look at the bus and what else is on it",
    ),
    "servo_skipped_fraction": Quantity(
        "part of the siderostat servo's periods that were skipped, over the last second",
        "computer",
        "free the computer, and the host of a virtual one, of other work; see the realtime rights",
    ),
    "piezo_limit_error_v": Quantity(
        "the voltage-limit switch as read, less the rig file's limit_v",
        "piezo amplifier",
        "set the switch back, or correct limit_v",
    ),
    "piezo_fault": Quantity(
        "1 while reading the piezo amplifier gives an error, else 0",
        "piezo amplifier",
        "remove its cause, then recover",
    ),
    "dac_unwritten_s": Quantity(
        "time since the D/A took its last voltages; its own watchdog acts on this",
        "D/A",
        "find out what delays the computer",
    ),
    "dac_round_trip_s": Quantity(
        "time of the last write to the D/A",
        "D/A",
        "look at its link and what else is on it",
    ),
    "frame_late_s": Quantity(
        "age of a frame when it came, less camera.frame_delay_s",
        "camera",
        "check the camera's power and link; `fitctl identify delay` measures the delay",
        every_frame=True,
    ),
    "frame_interval_periods": Quantity(
        "time between two exposures, in frame periods",
        "camera",
        "look for lost frames and at the camera's frame rate",
        every_frame=True,
    ),
    "tick_period_fraction": Quantity(
        "time that the last tick took, over the frame period",
        "computer",
        "free the computer, and the host of a virtual one, of other work; see the realtime rights",
    ),
    "disk_free_bytes": Quantity(
        "room left where the log is written",
        "computer",
        "make room, or choose another logging.folder",
    ),
    "recorder_backlog_fraction": Quantity(
        "records not yet in the file, over logging.queue_records",
        "computer",
        "look at the recorder's events and at the disk",
    ),
    "clock_step_s": Quantity(
        "how far wall time moved against monotonic time in a second",
        "computer",
        "look at the time service; wall times of this log differ before and after",
    ),
}


class Interlock(Settings):
    """One row: what is judged, in which modes, what counts as out of range, and what follows.

    A side without a limit is open; without ``stale_s`` a value does not age.
    """

    quantity: str
    low: Finite | None = None
    high: Finite | None = None
    stale_s: Positive | None = None
    for_s: NonNegative
    modes: Annotated[list[ModeName], Field(min_length=1)]
    action: Action
    reset: ResetBy

    @field_validator("quantity")
    @classmethod
    def _measured(cls, name: str) -> str:
        if name not in QUANTITIES:
            msg = f"unknown quantity; available: {', '.join(QUANTITIES)}"
            raise ValueError(msg)
        return name

    @model_validator(mode="after")
    def _can_trip(self) -> Interlock:
        if self.low is None and self.high is None and self.stale_s is None:
            msg = "needs low, high or stale_s, or it could never trip"
            raise ValueError(msg)
        if self.low is not None and self.high is not None:
            require_order(self.low, self.high)
        return self
