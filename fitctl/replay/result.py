"""How a replay went: where today's code decides otherwise than a log, and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

Compared = dict[str, tuple[str, ...]]
# What is compared: fields of a stellar loop's tick, of a metrology loop's, and of the overlap of two stars.
STELLAR_COMPARED: Compared = {
    "star_px": ("star_az_px", "star_el_px"),
    "mirror_rad": ("fsm_az_rad", "fsm_el_rad"),
    "stacks_v": ("stack1_v", "stack2_v", "stack3_v"),
    "siderostat_setpoint_rad": ("siderostat_setpoint_az_rad", "siderostat_setpoint_el_rad"),
}
METROLOGY_COMPARED: Compared = {
    "beam_arcsec": ("beam_az_arcsec", "beam_el_arcsec"),
    "rate_arcsec_s": ("rate_az_arcsec_s", "rate_el_arcsec_s"),
    "siderostat_setpoint_rad": ("siderostat_setpoint_az_rad", "siderostat_setpoint_el_rad"),
}
OVERLAP_COMPARED: Compared = {
    "tilt_arcsec": ("tilt_az_arcsec", "tilt_el_arcsec"),
    "visibility": ("visibility",),
}


@dataclass
class Difference:
    """Of one thing between the log and today's code, over the ticks in which both are in the same mode.

    Attributes
    ----------
    ticks : int
        In which it differs, be it in the last bit.
    first_s : float
        The first of them, monotonic time; NaN without one.
    worst : float
        The largest difference of a component; what is there only here or only then does not count.
    rms : float
        Root of the mean square over all ticks and components that were compared; NaN without one.
    """

    ticks: int = 0
    first_s: float = math.nan
    worst: float = 0.0
    compared: int = 0
    sum_of_squares: float = 0.0

    @property
    def rms(self) -> float:
        """Root of the mean square."""
        return math.sqrt(self.sum_of_squares / self.compared) if self.compared else math.nan

    def add(self, time_s: float, then: tuple[float, ...], now: tuple[float, ...]) -> None:
        """One tick's values."""
        self.compared += len(then)
        # Not a number is the same as not a number.
        same = all(a == b or (a != a and b != b) for a, b in zip(then, now, strict=True))  # noqa: PLR0124
        if same:
            return
        self._count(time_s)
        for a, b in zip(then, now, strict=True):
            if not math.isnan(a - b):
                self.worst = max(self.worst, abs(a - b))
                self.sum_of_squares += (a - b) ** 2

    def _count(self, time_s: float) -> None:
        self.ticks += 1
        if math.isnan(self.first_s):
            self.first_s = time_s


@dataclass
class ModeDifference:
    """Ticks in different modes; the first of them, and its modes then and now."""

    ticks: int = 0
    first_s: float = math.nan
    then: str = ""
    now: str = ""

    def add(self, time_s: float, then: str, now: str) -> None:
        """One tick's modes."""
        if then == now:
            return
        if not self.ticks:
            self.first_s, self.then, self.now = time_s, then, now
        self.ticks += 1


@dataclass
class LoopReplay:
    """How one loop's replay went.

    Attributes
    ----------
    ticks : int
    frames_missing : int
        Ticks that had a frame which is not in the log; they were replayed without one.
    mode : ModeDifference
    differences : dict of str to Difference
        By what is compared: the names of :data:`STELLAR_COMPARED` or :data:`METROLOGY_COMPARED`, and those of
        :data:`OVERLAP_COMPARED` for the first of the two loops.
    """

    ticks: int = 0
    frames_missing: int = 0
    mode: ModeDifference = field(default_factory=ModeDifference)
    differences: dict[str, Difference] = field(default_factory=dict)

    @classmethod
    def of(cls, compared: Compared) -> LoopReplay:
        """Nothing replayed yet."""
        return cls(differences={name: Difference() for name in compared})

    @property
    def same(self) -> bool:
        """Every mode, and every bit of every command."""
        return not self.mode.ticks and not any(d.ticks for d in self.differences.values())


@dataclass
class ReplayResult:
    """How a replay went.

    Attributes
    ----------
    loops : dict of str to LoopReplay
    refused : list of str
        Commands that were accepted then, and what is said to them today.
    controllers_left_out : int
        Commands of the log that would have changed a controller which was to stay.
    records_lost : int
        On the way to the log, as the recorder counted.
    start_s, end_s : float
        First and last tick, monotonic time.
    wall_s : float
        What the replay took.
    """

    loops: dict[str, LoopReplay]
    refused: list[str] = field(default_factory=list)
    controllers_left_out: int = 0
    records_lost: int = 0
    start_s: float = math.nan
    end_s: float = math.nan
    wall_s: float = math.nan

    @property
    def same(self) -> bool:
        """Nothing was decided otherwise."""
        return not self.refused and all(loop.same for loop in self.loops.values())
