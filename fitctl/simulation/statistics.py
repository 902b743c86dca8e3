"""Statistics of simulated runs: true residual, piston, and the time spent in each mode."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.logging.records import ModeChange
from fitctl.messages.modes import STELLAR_MODES, Mode
from fitctl.model.stellar_part import StellarPart

Floats = NDArray[np.float64]
LEAST_S = 1.0  # of a residual; less says little about its RMS
SETTLE_S = 10.0  # after vernier is reached, before its residual counts
TILT_EVERY = 10  # steps of the plant from one sample of the visibility to the next: 5 ms


class SimulationResult(NamedTuple):
    """What a simulated run gave; RMS about the target over `judged_s`, nan if that is 0.

    The piston's RMS is about its mean: what path-length control has to follow.
    """

    acquired_s: float
    vernier_s: float
    rms_px: dict[str, float]
    measured_rms_px: dict[str, float]
    judged_s: float
    piston_rms_m: float
    mode_times: dict[str, float]
    frames: int
    speed_x: float


class MetrologyResult(NamedTuple):
    """What a simulated run gave for a metrology loop; RMS of the beam's angle over `judged_s`.

    Of the beam from the centre of the photodiodes, in the plant, the air of the path included.
    """

    acquired_s: float
    locked_s: float
    rms_arcsec: dict[str, float]
    judged_s: float
    mode_times: dict[str, float]
    samples: int
    speed_x: float


class RigResult(NamedTuple):
    """What a simulated run gave: each loop's, and the mean visibility that the stars' true tilt left.

    The visibility is nan where the rig has no fringes, or its two loops did not hold their stars at one time.
    """

    loops: dict[str, SimulationResult | MetrologyResult]
    visibility: float
    speed_x: float


def of_enough(result: SimulationResult | MetrologyResult) -> SimulationResult | MetrologyResult:
    """A loop's result, without an RMS if it held its star or its beam for less than `LEAST_S` once settled."""
    if result.judged_s >= LEAST_S:
        return result
    nothing = pair(np.full(2, math.nan))
    if isinstance(result, MetrologyResult):
        return result._replace(rms_arcsec=nothing, judged_s=0.0)
    return result._replace(
        rms_px=nothing, measured_rms_px=nothing, piston_rms_m=math.nan, judged_s=0.0
    )


def motion_start_s(rig: Rig) -> float:
    """When a simulated run begins to move the collector; infinite if it never does."""
    if rig.collector is None or rig.collector.motion.kind == "still":
        return math.inf
    return rig.collector.motion.start_s


def true_residual_rms(
    plant: StellarPart, target_px: Floats, start_s: float, end_s: float
) -> Floats:
    """RMS distance of the pointing spot from `target_px` in continuous time, shape (2,); nan if empty."""
    if not start_s < end_s:
        return np.full(2, math.nan)
    return rms(plant.history_px(start_s, end_s)[:, 0, 0, :] - target_px)


def piston_rms_m(plant: StellarPart, start_s: float, end_s: float) -> float:
    """RMS of the mirror's piston (Eq. 4) about its mean; nan if the time is empty."""
    if not start_s < end_s:
        return math.nan
    return float(np.std(plant.history_piston_m(start_s, end_s)[:, 0]))


def rms(values: Floats) -> Floats:
    """Root of the mean square down the first axis; nan without values."""
    if len(values) == 0:
        return np.full(values.shape[1:], math.nan)
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def pair(values: Floats) -> dict[str, float]:
    """Two axes by name."""
    return {"az": float(values[0]), "el": float(values[1])}


def mode_times(
    changes: Iterable[ModeChange], end_s: float, modes: Iterable[Mode] = STELLAR_MODES
) -> dict[str, float]:
    """Seconds spent in each mode of a kind of loop."""
    times = dict.fromkeys((mode.name for mode in modes), 0.0)
    mode, since_s = Mode.OFF.name, 0.0
    for change in changes:
        times[mode] += change.time_s - since_s
        mode, since_s = change.target, change.time_s
    times[mode] += end_s - since_s
    return times
