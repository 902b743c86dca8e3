"""All findings of a report about a run, before they are drawn or written."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.logging.reading import Columns
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales
from fitctl.report.fringes import FringeFindings, find_fringes
from fitctl.report.gather import Gathered, counted, gather
from fitctl.report.rejection import Held, Rejection, held_by_controller, rejections
from fitctl.report.residual import Estimate, Verdict, Word, night_verdict, rms_estimate, verdict
from fitctl.report.run import Run
from fitctl.report.selection import Selection, select_frames, select_samples
from fitctl.report.stages import Stacks, Stages, stacks, stages

AXES = ("az", "el")
_Statistic = Callable[[Any], Any]
_OF_FRAMES: dict[str, tuple[str, _Statistic]] = {
    "age_median_s": ("frame_age_s", np.median),
    "age_worst_s": ("frame_age_s", np.max),
    "compute_median_s": ("compute_s", np.median),
    "compute_worst_s": ("compute_s", np.max),
}
# What is recorded of a second at a time: the median of medians, the worst of worsts.
_OF_SECONDS: dict[str, _Statistic] = {
    "servo_late_median_s": np.median,
    "servo_late_worst_s": np.max,
    "worst_stall_s": np.max,
}


class Quantity(NamedTuple):
    """What a kind of loop keeps small.

    Attributes
    ----------
    of : str
        What the loop holds.
    mode : Mode
        In which it holds it.
    unit : str
        Of error and requirement.
    field : str
        Of ticks: the error, with a place for the axis.
    """

    of: str
    mode: Mode
    unit: str
    field: str


STAR = Quantity("star", Mode.VERNIER, "px", "error_{}_px")
BEAM = Quantity("beam", Mode.LOCKED, "arcsec", "beam_{}_arcsec")


@dataclass(frozen=True)
class LoopFindings:
    """One loop of any kind.

    Attributes
    ----------
    name : str
    ticks : dict of str to array
        See :class:`fitctl.report.gather.Gathered`.
    quantity : Quantity
        What the loop keeps small.
    requirement : float
        RMS on each axis, in the quantity's unit.
    selection : Selection
    residual : dict of str to Estimate
        By axis.
    verdict : Verdict
    mode_s : dict of str to float
        Seconds in each mode that there was.
    counts : dict of str to int
        Frames, late ticks, frames lost, stalls.
    timing : dict of str to float
        Medians and worsts, seconds; nan where nothing was recorded.
    """

    name: str
    ticks: Columns
    quantity: Quantity
    requirement: float
    selection: Selection
    residual: dict[str, Estimate]
    verdict: Verdict
    mode_s: dict[str, float]
    counts: dict[str, int]
    timing: dict[str, float]

    def error(self, axis: str) -> NDArray[np.floating]:
        """Of every tick, in the quantity's unit; NaN where nothing was measured."""
        return self.ticks[self.quantity.field.format(axis)]

    @property
    def held(self) -> NDArray[np.bool_]:
        """The ticks on which the loop held its star or beam and measured it."""
        measured = ~np.isnan(self.error("az"))
        return (self.ticks["mode_number"] == self.quantity.mode) & measured


@dataclass(frozen=True)
class StarFindings(LoopFindings):
    """One stellar loop.

    Attributes
    ----------
    sky_arcsec_per_px : float
    held_by_controller : list of Held
    rejections : list of Rejection
    stacks : Stacks or None
    stages : Stages
    """

    sky_arcsec_per_px: float
    held_by_controller: list[Held]
    rejections: list[Rejection]
    stacks: Stacks | None
    stages: Stages


@dataclass(frozen=True)
class Findings:
    """A run, evaluated."""

    gathered: Gathered
    loops: dict[str, LoopFindings]
    fringes: FringeFindings | None

    @property
    def run(self) -> Run:
        """Its files and its rig."""
        return self.gathered.run

    @property
    def word(self) -> Word:
        """The verdict on all loops together."""
        return night_verdict([loop.verdict.word for loop in self.loops.values()])


def find(run: Run) -> Findings:
    """Read and evaluate a run.

    Raises
    ------
    LogError
        If it cannot be read.
    """
    gathered = gather(run)
    of_kind = dict.fromkeys(run.rig.stellar_loops, _star)
    of_kind |= dict.fromkeys(run.rig.metrology_loops, _beam)
    loops = {name: of_kind[name](gathered, name) for name in run.rig.loops}
    selections = {name: loop.selection for name, loop in loops.items()}
    return Findings(gathered, loops, find_fringes(gathered, selections))


def _beam(gathered: Gathered, name: str) -> LoopFindings:
    rig: Rig = gathered.run.rig
    ticks, requirement_arcsec = gathered.ticks[name], rig.metrology_loops[name].requirement_arcsec
    selection = select_samples(ticks, rig.camera.period_s)
    return LoopFindings(**_of_any(gathered, name, BEAM, requirement_arcsec, selection))


def _star(gathered: Gathered, name: str) -> LoopFindings:
    rig: Rig = gathered.run.rig
    ticks, settings = gathered.ticks[name], rig.stellar_loops[name]
    selection = select_frames(ticks, rig.camera.period_s, settings.requirement_px)
    found = stacks(rig, name, ticks)
    return StarFindings(
        **_of_any(gathered, name, STAR, settings.requirement_px, selection),
        sky_arcsec_per_px=scales(rig, settings).sky_arcsec_per_px,
        held_by_controller=held_by_controller(gathered, name, selection),
        rejections=rejections(gathered, name, selection),
        stacks=found,
        stages=stages(rig, name, ticks, selection, found),
    )


def _of_any(
    gathered: Gathered, name: str, quantity: Quantity, requirement: float, selection: Selection
) -> dict[str, Any]:
    """The fields of :class:`LoopFindings`."""
    ticks, rows = gathered.ticks[name], selection.rows
    residual = {axis: rms_estimate(ticks[quantity.field.format(axis)][rows]) for axis in AXES}
    return {
        "name": name,
        "ticks": ticks,
        "quantity": quantity,
        "requirement": requirement,
        "selection": selection,
        "residual": residual,
        "verdict": verdict(
            residual,
            requirement,
            selection.evaluated_s,
            selection.measured_fraction,
            mode=quantity.mode.name,
            of=quantity.of,
        ),
        "mode_s": _mode_s(ticks, gathered.run.rig.camera.period_s),
        "counts": _counts(ticks, gathered.timing[name]),
        "timing": _timing(ticks, gathered.timing[name]),
    }


def _mode_s(ticks: Columns, period_s: float) -> dict[str, float]:
    """By the ticks; unknown where no tick came for long."""
    lasted_s = np.minimum(np.diff(ticks["time_s"], append=np.nan), 1.0)
    lasted_s[-1:] = period_s
    spent = {mode.name: float(lasted_s[ticks["mode_number"] == mode].sum()) for mode in Mode}
    return {mode: seconds for mode, seconds in spent.items() if seconds > 0}


def _counts(ticks: Columns, timing: Columns) -> dict[str, int]:
    stalls: Any = timing.get("stalls", np.zeros(0))
    lost = ticks["frames_lost"]  # since the camera was opened
    return {
        "frames": int(np.count_nonzero(ticks["number"] >= 0)),
        "late_ticks": int(ticks["late"].sum()),
        "frames_lost": counted(lost, before=int(lost[0])) if len(lost) else 0,
        "stalls": int(stalls.sum()),
    }


def _timing(ticks: Columns, timing: Columns) -> dict[str, float]:
    frames = ticks["number"] >= 0
    series = {name: (ticks[field][frames], of) for name, (field, of) in _OF_FRAMES.items()}
    series |= {name: (timing.get(name, np.empty(0)), of) for name, of in _OF_SECONDS.items()}
    # A second without a servo's period has no lateness.
    known = {name: (values[~np.isnan(values)], of) for name, (values, of) in series.items()}
    return {
        name: float(of(values)) if len(values) else math.nan for name, (values, of) in known.items()
    }
