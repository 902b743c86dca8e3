"""Telemetry that a supervisor publishes: what consoles, `fitctl watch` and the metrics show."""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from fitctl.config import Action, ResetBy
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
from fitctl.messages.commands import PROTOCOL_VERSION, LearnerReport, SequenceStatus


class TrippedInterlock(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the table of interlocks that is in force; ``reason`` ends with what to do."""

    name: str
    since_s: float
    action: Action
    reset: ResetBy
    reason: str


class Watched(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the table of interlocks beside what is measured; NaN where nothing was."""

    name: str
    quantity: str
    value: float
    age_s: float
    low: float | None
    high: float | None
    stale_s: float | None
    action: Action
    judged: bool


class LoopLimits(msgspec.Struct, frozen=True, kw_only=True):
    """How far a loop's stages go, and what its search does, from the rig file."""

    fsm_range_rad: float
    siderostat_travel_sky_arcsec: float
    search_radius_sky_arcsec: float
    spiral_pitch_sky_arcsec: float


class SearchAgain(msgspec.Struct, frozen=True, kw_only=True):
    """The search for a star that was followed and lost.

    It goes in rounds, each a pause at the star's last place and a spiral about it. ``limit_s`` is how long it
    lasts at most; None is until a command ends it.
    """

    since_s: float
    round_number: int
    radius_sky_arcsec: float
    pauses: bool
    limit_s: float | None


class CommandOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """How a command that takes time ends in one loop.

    It is "under way" until it ends, once: "done", "failed", or "ended" because another command replaced it.

    Attributes
    ----------
    number : int
        That of the reply that accepted the command.
    command : str
        Its word on a command line.
    began_s, ended_s : float
        By the supervisor's clock; ``ended_s`` is NaN while the command is under way.
    text : str
        What happened. Of a failure it ends with what to do.
    """

    number: int
    command: str
    began_s: float
    state: Literal["under way", "done", "failed", "ended"] = "under way"
    ended_s: float = math.nan
    text: str = ""


class LoopFailure(msgspec.Struct, frozen=True, kw_only=True):
    """What failed last in a loop, until it accepts another command; ``text`` ends with what to do."""

    what: str
    time_s: float
    text: str


class SpotPlace(msgspec.Struct, frozen=True, kw_only=True):
    """A spot that moves with a loop's star, and how far from it, by the rig file."""

    name: str
    az_offset_px: float
    el_offset_px: float


class LearningState(msgspec.Struct, frozen=True, kw_only=True):
    """What was learnt from a loop's own frames, and what became of it.

    Attributes
    ----------
    setting : str
        ``learn`` of the rig file.
    state : str
        "collecting" until the first report; "advice" where the learnt design would leave clearly less; "kept"
        where it would not; "failed" where nothing could be learnt, and `text` says why; "in force" while it
        drives the loop; "fell back" after it left too much.
    text : str
        The night, or what happened, for people.
    report : LearnerReport, optional
        The last one.
    design_json : str
        Of the learnt design in force; empty without.
    expected_px, measured_px : float
        RMS of the error on frames with the learnt design in force; NaN without. The measured one leaves out
        what is near known aliases.
    before_px : float
        RMS on the same frames that the design before would have left, by computation, and of known aliases in
        truth; NaN where it is not known.
    """

    setting: Literal["off", "advise", "on"]
    state: Literal["collecting", "advice", "kept", "failed", "in force", "fell back"]
    text: str = ""
    report: LearnerReport | None = None
    design_json: str = ""
    expected_px: float = math.nan
    measured_px: float = math.nan
    before_px: float = math.nan


class LoopState(msgspec.Struct, frozen=True, kw_only=True):
    """One loop as consoles show it.

    ``controller_file`` is the saved design in force, on the supervisor's machine, and ``controller_digest``
    stands for the design as it was loaded; both are empty when the design was made from the rig's values.
    ``outcomes`` are those of the commands under way, and of the last that ended. ``kind`` is the loop's in the
    rig file; a metrology loop's ``requirement_px`` is its requirement on the beam in the camera's pixels.
    ``waits_for`` is what the loop waits for while it holds its stages where they are, for people; empty while
    it waits for nothing. ``noise_px`` is the sensor's noise for which the design was made anew, from the star's
    measured light; null for a design for the light of the rig file.
    """

    name: str
    mode: str
    since_s: float
    requirement_px: float
    sky_arcsec_per_px: float
    usable_commands: list[str]
    controller: str = ""
    last_change: ModeChange | None = None
    interlocks: list[TrippedInterlock] = []
    limits: LoopLimits | None = None
    watched: list[Watched] = []
    bias_offset_urad: tuple[float, float] = (0.0, 0.0)
    search_centre_sky_arcsec: tuple[float, float] | None = None
    other_spots: list[SpotPlace] = []
    controller_file: str = ""
    controller_digest: str = ""
    search_again: SearchAgain | None = None
    outcomes: list[CommandOutcome] = []
    last_failure: LoopFailure | None = None
    kind: Literal["stellar", "metrology"] = "stellar"
    waits_for: str = ""
    learning: LearningState | None = None
    noise_px: float | None = None

    @property
    def design(self) -> str:
        """What the design in force is made from: its parameters if it is learnt, its file, or its name."""
        learnt = "" if self.learning is None else self.learning.design_json
        return learnt or self.controller_file or self.controller

    @property
    def why(self) -> str:
        """The reason of the last change of mode; empty before the first."""
        return "" if self.last_change is None else self.last_change.reason


class CollectorState(msgspec.Struct, frozen=True, kw_only=True):
    """What moves the collector.

    ``busy`` while a command for it is carried out. ``motion`` is the kind of motion that goes on, empty while
    there is none; ``az_mm`` and ``el_mm`` are where it has the collector, from its start. ``error`` is what
    went wrong last, empty since something went well.
    """

    busy: bool
    motion: str
    az_mm: float
    el_mm: float
    error: str


class Unlogged(msgspec.Struct, frozen=True, kw_only=True):
    """The part of telemetry that is in no record but :class:`fitctl.logging.records.Snapshot`.

    Fields as in :class:`Telemetry`.
    """

    loops: list[LoopState]
    scheduling: str = ""
    running_sequence: SequenceStatus | None = None
    commander: str = ""
    collector: CollectorState | None = None
    stopped_by: str = ""
    fringes: FringeOptics | None = None


class FringeOptics(msgspec.Struct, frozen=True, kw_only=True):
    """Which two loops' stars interfere, and at what aperture and wavelength, from the rig file."""

    loops: tuple[str, str]
    aperture_m: float
    wavelength_m: float


class Telemetry(msgspec.Struct, frozen=True, kw_only=True):
    """Sent `telemetry_hz` times a second.

    Ticks, events and mode changes are those since the last message; of everything else it has the newest.
    ``commander`` is who has the instrument, empty while nobody has.
    ``stopped_by`` is who sent the last `stop`, empty before the first one.
    ``sequence`` counts the messages: a gap in it are those that this console was too slow for.
    ``recorder`` is what the recorder reported last, None before its first report; ``recorder_started_s`` is
    when the one that runs now was started, None if none runs.
    ``shutting_down`` is set from when the supervisor begins to end.
    """

    version: int = PROTOCOL_VERSION
    sequence: int
    time_s: float
    wall_minus_monotonic_s: float
    rig_name: str
    pid: int
    loops: list[LoopState]
    ticks: list[Tick]
    events: list[Event]
    mode_changes: list[ModeChange]
    frame: FrameRecord | None
    devices: list[DeviceHealth]
    piezo: list[PiezoReading]
    timing: list[LoopTiming]
    recorder: RecorderStatus | None
    losses: Losses
    scheduling: str
    running_sequence: SequenceStatus | None = None
    commander: str = ""
    metrology_ticks: list[MetrologyTick] = []
    overlaps: list[Overlap] = []
    collector: CollectorState | None = None
    stopped_by: str = ""
    fringes: FringeOptics | None = None
    recorder_started_s: float | None = None
    shutting_down: bool = False

    @property
    def recorder_awaited(self) -> bool:
        """A recorder runs that has not reported yet: whether it records is not known."""
        return self.recorder is None and self.recorder_started_s is not None

    @property
    def unlogged(self) -> Unlogged:
        """What no other record has."""
        return Unlogged(**{name: getattr(self, name) for name in Unlogged.__struct_fields__})

    @property
    def records_lost(self) -> int:
        """Records missing from the log: the supervisor's count and the recorder's are of the same gaps."""
        return max(self.losses.records_lost, 0 if self.recorder is None else self.recorder.lost)
