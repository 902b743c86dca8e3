"""What the supervisor reports, as plain structures: the log, the console and the scripts all read these.

Times named ``time_s`` are the host's monotonic clock; :class:`RunInfo` carries the offset to wall time.
A field's unit is in its name; a value that does not exist at a tick is NaN.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import msgspec

RECORD_VERSION = 1
Severity = Literal["info", "warning", "error"]
FailingDevice = Literal[
    "camera", "siderostat", "D/A", "D/A between frames", "injector", "piezo", "photodiodes"
]
CAMERA: Final = "camera"
HEXAPOD: Final = "hexapod"
MOST = 1e15
"""Beyond all times and numbers that an instrument logs: what is not less was not recorded by fitctl."""


class Record(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """The common base: everything that is recorded has a time."""

    time_s: float


class RunInfo(Record, frozen=True, kw_only=True):
    """The first record of a run: what is needed to understand all others."""

    wall_minus_monotonic_s: float
    rig_name: str
    rig_json: str
    versions: dict[str, str]
    scheduling: str
    random_seed: int | None = None
    designs: dict[str, str] = {}  # by loop, as `fitctl design --out` saves them
    dark_npy: bytes | None = None  # the file that camera.dark_file names, as it was read


class Tick(Record, frozen=True, kw_only=True, gc=False):
    """One tick of one loop: the frame, if one arrived, and the command computed from it."""

    loop: str
    number: int
    mode: str
    mode_number: int
    mid_exposure_s: float
    frame_age_s: float
    compute_s: float
    late: bool
    frames_lost: int
    star_visible: bool
    star_az_px: float
    star_el_px: float
    star_flux_dn: float
    window_az_px: int
    window_el_px: int
    target_az_px: float
    target_el_px: float
    error_az_px: float
    error_el_px: float
    fsm_az_rad: float
    fsm_el_rad: float
    fsm_range_fraction: float
    fsm_saturated: bool
    stack1_v: float
    stack2_v: float
    stack3_v: float
    siderostat_az_rad: float
    siderostat_el_rad: float
    siderostat_setpoint_az_rad: float
    siderostat_setpoint_el_rad: float
    siderostat_az_sky_arcsec: float
    siderostat_el_sky_arcsec: float
    search_progress: float
    # What the tick took from outside besides the frame, so that it can be replayed: when the D/A confirmed
    # its voltages, how long it and the amplifiers took, the least following error since the last tick, and the
    # encoders as last read.
    fsm_written_s: float = math.nan
    dac_round_trip_s: float = math.nan
    amplifier_round_trip_s: float = math.nan
    following_error_rad: float = math.nan
    encoder_read_s: float = math.nan
    encoder_az_rad: float = math.nan
    encoder_el_rad: float = math.nan
    # Of `compute_s`: measuring the star, and deciding; what is left is the D/A: sending, and waiting for its
    # confirmation, which comes at `fsm_written_s`.
    sense_s: float = math.nan
    decide_s: float = math.nan
    dac_sent_s: float = math.nan
    frames_skipped: int = 0  # since the camera was opened: a newer frame was there already
    # Of the siderostat of the loop's link, when `siderostat_az_rad` was read; NaN without a link.
    link_az_rad: float = math.nan
    link_el_rad: float = math.nan
    # How sure the sensor was of where the star is, one standard deviation; NaN without a star.
    star_sigma_az_px: float = math.nan
    star_sigma_el_px: float = math.nan
    # Where the mirror was at mid-exposure, by the identified hysteresis.
    mirror_az_rad: float = math.nan
    mirror_el_rad: float = math.nan
    # Motor angles that turn the star as far as it has moved by itself; NaN where it stands.
    sky_az_rad: float = math.nan
    sky_el_rad: float = math.nan
    held: bool = (
        False  # an interlock, or a wait for the link, kept the stages from following the star
    )


class MetrologyTick(Record, frozen=True, kw_only=True, gc=False):
    """One tick of one metrology loop.

    ``number`` is the frame's that set its pace, as in :class:`Tick`. Beam angles are those of the beam from the
    centre of its photodiodes; they are NaN at a tick without a new sample. ``sampled_s`` is when the sample was
    taken that the tick used, ``requested_s`` when the tick requested the next; NaN without. Fields of the same
    name mean the same as in :class:`Tick`.
    """

    loop: str
    number: int
    mode: str
    mode_number: int
    frame_age_s: float
    compute_s: float
    late: bool
    frames_lost: int
    sampled_s: float
    beam_state: str
    beam_az_m: float
    beam_el_m: float
    beam_az_arcsec: float
    beam_el_arcsec: float
    noise_az_arcsec: float
    noise_el_arcsec: float
    diode_az_plus_v: float
    diode_az_minus_v: float
    diode_el_plus_v: float
    diode_el_minus_v: float
    rate_az_arcsec_s: float
    rate_el_arcsec_s: float
    siderostat_az_rad: float
    siderostat_el_rad: float
    siderostat_setpoint_az_rad: float
    siderostat_setpoint_el_rad: float
    siderostat_az_sky_arcsec: float
    siderostat_el_sky_arcsec: float
    search_progress: float
    amplifier_round_trip_s: float
    following_error_rad: float
    encoder_read_s: float
    encoder_az_rad: float
    encoder_el_rad: float
    sense_s: float
    decide_s: float
    requested_s: float = math.nan


class Overlap(Record, frozen=True, kw_only=True, gc=False):
    """The tilt between two loops' stars on one frame, and the fringe visibility that it leaves.

    ``time_s`` is mid-exposure. The tilt is that of ``loop`` less that of ``other_loop``, each star from its
    loop's ``target_px`` in the rig file, as an angle on the sky along the camera's axes. Where a star is not
    held, tilt and visibility are NaN.
    """

    loop: str
    other_loop: str
    number: int
    tilt_az_arcsec: float
    tilt_el_arcsec: float
    visibility: float


class FrameRecord(Record, frozen=True, kw_only=True, gc=False):
    """One whole camera frame; ``data`` is little-endian 16 bit, row by row. ``time_s`` is mid-exposure."""

    camera: str
    number: int
    width_px: int
    height_px: int
    data: bytes


class ModeChange(Record, frozen=True, kw_only=True):
    """A loop changed its mode; with the motor angles, also of its link, that it read then."""

    loop: str
    source: str
    target: str
    target_number: int
    trigger: str
    reason: str
    siderostat_az_rad: float = math.nan
    siderostat_el_rad: float = math.nan
    link_az_rad: float = math.nan
    link_el_rad: float = math.nan


class CommandRecord(Record, frozen=True, kw_only=True):
    """A command and its answer: sender, address, and values as JSON; an empty loop means all loops."""

    sender: str
    address: str
    command: str
    loop: str
    values_json: str
    accepted: bool
    text: str


class DevicesOpened(Record, frozen=True, kw_only=True):
    """A loop's devices were opened: the outputs that the D/A had; or why they could not be opened."""

    loop: str
    stack1_v: float
    stack2_v: float
    stack3_v: float
    encoders_jumped: bool
    error: str


class OutputsFound(Record, frozen=True, kw_only=True):
    """After a pause, the D/A's outputs differed from those sent last; NaN if it did not answer."""

    loop: str
    stack1_v: float
    stack2_v: float
    stack3_v: float


class StarPlace(Record, frozen=True, kw_only=True):
    """Position of the star that a killed supervisor held: on the camera, with the loop's own stages at zero.

    The motors are where they were then; without a link, those of its siderostat are at 0. `moved_az_rad` and
    `moved_el_rad` say how far the star had moved by itself, as angles of the motors; NaN is unknown.
    """

    loop: str
    az_px: float
    el_px: float
    siderostat_az_rad: float
    siderostat_el_rad: float
    link_az_rad: float = 0.0
    link_el_rad: float = 0.0
    moved_az_rad: float = math.nan
    moved_el_rad: float = math.nan
    rate_is_given: bool = False  # by `acquire`; else it is that of the rig file
    rate_az_sky_arcsec_s: float = 0.0
    rate_el_sky_arcsec_s: float = 0.0


class BeamPlace(Record, frozen=True, kw_only=True):
    """Middle of the search in which a killed supervisor had not found the beam, and where the motors were."""

    loop: str
    search_az_rad: float
    search_el_rad: float
    siderostat_az_rad: float
    siderostat_el_rad: float


Place = StarPlace | BeamPlace


class DeviceFailure(Record, frozen=True, kw_only=True):
    """A device failed in use; recorded once, however long it lasts. The kind is the error's class."""

    loop: str
    device: FailingDevice
    kind: str
    error: str


class ControllerChange(Record, frozen=True, kw_only=True):
    """Another design is in force from the next tick on; motor angles as in :class:`ModeChange`."""

    loop: str
    source: str
    target: str
    siderostat_az_rad: float
    siderostat_el_rad: float
    link_az_rad: float = math.nan
    link_el_rad: float = math.nan
    reason: str = ""
    design_json: str = ""  # as `fitctl design --out` saves it


class QuantityReading(Record, frozen=True, kw_only=True):
    """A quantity of the computer that interlocks watch, about once a second; for all loops."""

    name: str
    value: float


class ExperimentStart(Record, frozen=True, kw_only=True):
    """An experiment begins: its motions as JSON, one :class:`fitctl.model.drives.Drive` each."""

    loop: str
    name: str
    drives_json: str


class InjectionRecord(Record, frozen=True, kw_only=True):
    """Voltages at the D/A, written outside the tick; ``time_s`` is when they took effect."""

    loop: str
    stack1_v: float
    stack2_v: float
    stack3_v: float


class Event(Record, frozen=True, kw_only=True):
    """A message for the operator."""

    severity: Severity
    source: str
    message: str


class DeviceHealth(Record, frozen=True, kw_only=True):
    """State of one device, about once a second."""

    device: str
    endpoint: str
    state: Literal["ok", "fault", "closed"]
    identity: str
    detail: str


class PiezoReading(Record, frozen=True, kw_only=True):
    """Measured stack voltages, about once a second."""

    loop: str
    stack1_v: float
    stack2_v: float
    stack3_v: float
    limit_v: float


class LoopTiming(Record, frozen=True, kw_only=True):
    """Timing over the last second: frame loop and position servo; frames lost since the camera was opened."""

    loop: str
    ticks: int
    late_ticks: int
    frames_lost: int
    compute_median_s: float
    compute_worst_s: float
    frame_age_median_s: float
    frame_age_worst_s: float
    servo_periods: int
    servo_late_median_s: float
    servo_late_worst_s: float
    servo_missed: int
    stalls: int
    worst_stall_s: float
    servo_skipped: int = 0


class RecorderStatus(Record, frozen=True, kw_only=True):
    """Progress of the recorder: records written and lost, and the present file."""

    path: str
    records: int
    lost: int
    bytes_written: int


class Losses(Record, frozen=True, kw_only=True):
    """Records offered to and lost by each queue of the supervisor since the start; once a second."""

    records_offered: int
    records_lost: int
    ticks_unsent: int
    events_unsent: int
    mode_changes_unsent: int
    replies_unsent: int

    @property
    def unsent(self) -> dict[str, int]:
        """Messages that were dropped because their receiver was too slow, by kind."""
        return {
            name.removesuffix("_unsent"): getattr(self, name)
            for name in self.__struct_fields__
            if name.endswith("_unsent")
        }


class Snapshot(Record, frozen=True, kw_only=True):
    """Data that only consoles show, about once a second, as MessagePack.

    ``state_msgpack`` is a :class:`fitctl.messages.telemetry.Unlogged`.
    """

    state_msgpack: bytes


class SequenceAttempt(Record, frozen=True, kw_only=True):
    """One attempt at one step of a sequence, when it ended; figures as JSON, units in their names.

    ``star`` is the one of a list that the step was for.
    """

    sequence_name: str
    step_number: int
    step: str
    loop: str
    attempt: int
    began_s: float
    ended_s: float
    outcome: Literal["done", "failed", "timed out", "stopped"]
    message: str
    figures_json: str
    star: str = ""


AnyRecord = (
    RunInfo
    | Tick
    | MetrologyTick
    | Overlap
    | FrameRecord
    | ModeChange
    | DevicesOpened
    | OutputsFound
    | StarPlace
    | BeamPlace
    | DeviceFailure
    | ControllerChange
    | QuantityReading
    | ExperimentStart
    | InjectionRecord
    | Event
    | DeviceHealth
    | PiezoReading
    | LoopTiming
    | RecorderStatus
    | Losses
    | SequenceAttempt
    | CommandRecord
    | Snapshot
)


class Envelope(msgspec.Struct, frozen=True, array_like=True):
    """A record on its way to the recorder.

    ``sequence`` counts every record offered, so that the recorder sees a gap as records lost.
    """

    version: int
    sequence: int
    record: AnyRecord
