"""The frames of a loop from which its residual is computed, and the pieces that are whole."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.error_budget import LONGEST_GAP_S, ends_piece
from fitctl.identify.record import axis_pair
from fitctl.logging.reading import Columns
from fitctl.messages.modes import BEAM_FOLLOWING, FOLLOWING, Mode
from fitctl.simulation.statistics import SETTLE_S

TARGET_SETTLE_S = 2.0
_TARGET_MOVES = 0.5  # requirements a second: slower is no motion


class Selection(NamedTuple):
    """The part of a run that is evaluated for a loop.

    Attributes
    ----------
    pieces : list of array of int
        Rows of ticks with a frame and a star, or with a measured beam, piece by piece, nothing longer than
        `LONGEST_GAP_S` missing within one.
    held_s : float
        All time in VERNIER, or LOCKED for a metrology loop.
    evaluated_s : float
        Of it, what counts.
    measured_fraction : float
        Part of the frames that count in which the star, or the beam, was measured; nan without any.
    """

    pieces: list[NDArray[np.intp]]
    held_s: float
    evaluated_s: float
    measured_fraction: float

    @property
    def rows(self) -> NDArray[np.intp]:
        """Of all pieces."""
        return np.concatenate([np.empty(0, np.intp), *self.pieces])


def select_frames(ticks: Columns, period_s: float, requirement_px: float) -> Selection:
    """Choose the frames: VERNIER, from `SETTLE_S` after it began and `TARGET_SETTLE_S` after the target moved.

    Parameters
    ----------
    ticks : dict of str to array, shape (ticks,)
        As :class:`fitctl.report.gather.Gathered` has them.
    period_s : float
        Of frames.
    requirement_px : float
        The target moves if it would pass half of this in a second.
    """
    rows = np.flatnonzero((ticks["mode_number"] == Mode.VERNIER) & (ticks["number"] >= 0))
    moves = _moves(ticks, rows, requirement_px)
    return _select(ticks, rows, ticks["star_visible"], ticks["mid_exposure_s"], moves, period_s)


def select_samples(ticks: Columns, period_s: float) -> Selection:
    """Choose the samples of a metrology loop: LOCKED, from `SETTLE_S` after it began.

    A tick without a new sample of the photodiodes does not count at all.

    Parameters
    ----------
    ticks : dict of str to array, shape (ticks,)
        As :class:`fitctl.report.gather.Gathered` has them.
    period_s : float
        Of ticks.
    """
    sampled = ~np.isnan(ticks["diode_az_plus_v"])
    rows = np.flatnonzero((ticks["mode_number"] == Mode.LOCKED) & sampled)
    measured = ~np.isnan(ticks["beam_az_arcsec"])
    return _select(ticks, rows, measured, ticks["time_s"], np.zeros(len(rows), bool), period_s)


def _select(
    ticks: Columns,
    rows: NDArray[np.intp],
    measured: NDArray[np.bool_],
    measured_at_s: NDArray[np.float64],
    moves: NDArray[np.bool_],
    period_s: float,
) -> Selection:
    """Of rows in one mode: those long enough after it began, and after the target moved."""
    if len(rows) == 0:
        return Selection([], 0.0, 0.0, float("nan"))
    time_s = ticks["time_s"][rows]
    # A stretch ends where another mode came between, or nothing for long.
    begins = np.ones(len(rows), bool)
    left = np.cumsum(ticks["mode_number"] != ticks["mode_number"][rows[0]])[rows]
    begins[1:] = (np.diff(left) > 0) | (np.diff(time_s) > LONGEST_GAP_S)
    since_s = time_s - last_marked(time_s, begins)
    still_s = time_s - last_marked(time_s, moves | begins)
    counts = (since_s >= SETTLE_S) & (still_s >= TARGET_SETTLE_S)
    used = rows[counts & measured[rows]]
    at_s = measured_at_s[used]
    apart = ends_piece(at_s) | (np.diff(np.cumsum(begins)[np.searchsorted(rows, used)]) > 0)
    pieces = np.split(used, np.flatnonzero(apart) + 1) if len(used) else []
    return Selection(
        pieces=[piece for piece in pieces if len(piece) > 1],
        held_s=len(rows) * period_s,
        evaluated_s=int(np.count_nonzero(counts)) * period_s,
        measured_fraction=len(used) / int(np.count_nonzero(counts))
        if counts.any()
        else float("nan"),
    )


def searches_for_lost_star(ticks: Columns) -> list[float]:
    """How long each search for a star or beam that had been followed lasted, s.

    One at the run's end counts so far.
    """
    modes, time_s = ticks["mode_number"], ticks["time_s"]
    searching = modes == Mode.ACQUISITION
    followed = np.isin(modes, sorted(FOLLOWING | BEAM_FOLLOWING))
    begins = (np.flatnonzero(searching[1:] & followed[:-1]) + 1).tolist()
    ends = [int(begin + np.argmin(np.r_[searching[begin:], False])) for begin in begins]
    last = len(modes) - 1
    return [
        float(time_s[min(end, last)] - time_s[begin])
        for begin, end in zip(begins, ends, strict=True)
    ]


def last_marked(values: NDArray[Any], marked: NDArray[np.bool_]) -> NDArray[Any]:
    """At each place, the value where it was marked last; the first counts as marked."""
    index = np.where(marked, np.arange(len(values)), 0)
    return values[np.maximum.accumulate(index)]


def _moves(ticks: Columns, rows: NDArray[np.intp], requirement_px: float) -> NDArray[np.bool_]:
    """Whether the target is on its way, at each of some rows."""
    if len(rows) == 0:
        return np.zeros(0, bool)
    target_px = axis_pair(ticks, "target_{}_px")[rows]
    step_px = np.abs(np.diff(target_px, axis=0, prepend=target_px[:1])).max(axis=1)
    step_s = np.diff(ticks["time_s"][rows], prepend=ticks["time_s"][rows[0]] - 1.0)
    return step_px > _TARGET_MOVES * requirement_px * np.maximum(step_s, 1e-6)
