"""The loop, opened on paper: periodograms of what would have moved the star with the stages at rest.

What the camera measured, less where the stages had moved the star, is the disturbance (rebuilt by
:func:`fitctl.error_budget.motion`, as for the error budget). The mirror may move otherwise than the rig file
says: by a gain; and at mid-exposure beyond its last step by a part of it (its mount rings), or short of it (the
command came late). This is a linear filter of its motion, so that periodograms of both and between both serve
every gain and every overshoot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.error_budget import Columns, LoopTheory, in_force, motion, taper
from fitctl.learn.gaps import filled

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
SEGMENT_S = 128.0
"""Segments are about so long, at most 1.5 times: the air's slow pole turns over within a few seconds."""
LEAST_S = 20.0
"""Shorter pieces are left out."""
TAPERED = 0.2
"""Part of a segment over which its window rises and falls (Tukey): the spectrum falls by five decades, and
without a taper the leakage of slow motion covers the fast."""
_FIRST_BINS = 2.5  # below, the mean that was removed and the taper leave too little
_OFF_TIME = 0.1
"""Of a frame period: commands may come so much earlier or later than usual and still be timely."""
_OFF_SPREAD = 6.0
"""Times their median deviation: so may commands that never come at quite the same time."""
_HALF_WIDTH_BINS = 0.5  # of a pure sine, as the window shows it


class Series(NamedTuple):
    """Frames in their order, without gaps; arrays of shape (frames, axes), in px.

    Attributes
    ----------
    disturbance_px : array
        Rebuilt, with a mirror that moves as the rig file has it.
    mirror_px : array
        Where the mirror had moved the star at mid-exposure.
    filled : int
        How many frames are missing or met a late command; they were filled from those beside them.
    """

    disturbance_px: Floats
    mirror_px: Floats
    filled: int = 0


class AnyMirror(NamedTuple):
    """Periodograms of the disturbance: a polynomial of the mirror's gain and overshoot.

    Attributes
    ----------
    disturbance : array, shape (axes, rows)
        For a mirror that moves as the rig file has it,
    cross, turned : arrays, shape (axes, rows)
        by how much more for each part by which its gain is less, and less for each part of overshoot,
    squares : array, shape (3, axes, rows)
        and what goes with their squares and their product: gain, both, overshoot.
    """

    disturbance: Floats
    cross: Floats
    turned: Floats
    squares: Floats

    def periodograms(self, gain: float, overshoot: float) -> Floats:
        """For a mirror that moves so, shape (axes, rows)."""
        less = 1 - gain
        by_gain, by_both, by_overshoot = self.squares
        found = self.disturbance + less * self.cross - overshoot * self.turned
        found += less**2 * by_gain - 2 * less * overshoot * by_both + overshoot**2 * by_overshoot
        return found

    def slopes(self, gain: float, overshoot: float) -> Floats:
        """Of :meth:`periodograms`, by the gain's logarithm and by the overshoot, shape (2, axes, rows)."""
        less = 1 - gain
        by_gain, by_both, by_overshoot = self.squares
        return np.array(
            [
                -gain * (self.cross + 2 * less * by_gain - 2 * overshoot * by_both),
                2 * overshoot * by_overshoot - self.turned - 2 * less * by_both,
            ]
        )


class Opened(NamedTuple):
    """One-sided periodograms of the rebuilt disturbance, px²/Hz; its rows are the frequencies of all segments.

    Attributes
    ----------
    frequency_hz : array, shape (rows,)
        Ascending.
    disturbance, cross, mirror : arrays, shape (rows, axes)
        Of the disturbance, of both (complex), and of the mirror's motion; means over segments.
    segments : array, shape (rows,)
        How many there are.
    resolution_hz : array, shape (rows,)
        Half width of a pure sine.
    period_s : float
        Of frames.
    duration_s : float
        Of all segments.
    inflation : float
        By how much the window makes neighbouring frequencies repeat each other.
    """

    frequency_hz: Floats
    disturbance: Floats
    cross: Complexes
    mirror: Floats
    segments: Floats
    resolution_hz: Floats
    period_s: float
    duration_s: float
    inflation: float

    @property
    def any_mirror(self) -> AnyMirror:
        """Periodograms of the disturbance for every gain and overshoot of the mirror."""
        # From the mirror's motion to its last step, m(k) - m(k - 1).
        step = 1 - np.exp(-2j * np.pi * self.frequency_hz * self.period_s)
        cross, mirror = self.cross.T, self.mirror.T
        return AnyMirror(
            np.ascontiguousarray(self.disturbance.T),
            2 * cross.real,
            2 * (step.conj() * cross).real,
            np.array([mirror, mirror * step.real, mirror * np.abs(step) ** 2]),
        )

    def with_mirror(self, gain: float, overshoot: float) -> Floats:
        """Periodograms of the disturbance if the mirror moves so, shape (rows, axes)."""
        return self.any_mirror.periodograms(gain, overshoot).T


def rebuild(
    theory: LoopTheory,
    ticks: Columns,
    pieces: Sequence[NDArray[np.intp]],
    mirror_rad: Floats | None = None,
) -> list[Series]:
    """Open a loop again, piece by piece.

    Parameters
    ----------
    theory : LoopTheory
        For scales and backlash.
    ticks : mapping of str to array, shape (ticks,)
        Fields of :class:`fitctl.logging.records.Tick`, from a log or from telemetry.
    pieces : sequence of array of int
        Rows with a star in VERNIER; frames that one lacks, or that a late command met, are filled.
    mirror_rad : array, shape (ticks, 2), optional
        As :func:`fitctl.error_budget.motion` takes it.
    """
    disturbance_px = motion(theory, ticks, mirror_rad).disturbance_px
    if mirror_rad is None:
        columns = [np.asarray(ticks[f"mirror_{axis}_rad"], dtype=float) for axis in ("az", "el")]
        mirror_rad = np.stack(columns, axis=-1)
    both = np.hstack([disturbance_px, mirror_rad @ theory.mirror_px_per_rad.T])
    series = []
    for rows in pieces:
        apart = np.diff(ticks["mid_exposure_s"][rows]) / theory.period_s
        at = np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(apart)).astype(int))])
        known = np.zeros(at[-1] + 1, bool)
        values = np.zeros((len(known), both.shape[1]))
        known[at] = _timely(ticks, rows, theory.period_s)
        values[at] = both[rows]
        values = filled(values, known)
        series.append(Series(values[:, :2], values[:, 2:], int(np.count_nonzero(~known))))
    return series


def _timely(ticks: Columns, rows: NDArray[np.intp], period_s: float) -> NDArray[np.bool_]:
    """Whether the command in force at mid-exposure had come at its usual time, shape (rows,).

    If not, the mirror's place is not known well: a late command may have acted before it was confirmed, or
    during the exposure. Six such frames in a thousand made the mirror's estimated gain 0.05 too small, 80 made
    it 0.3 too small (line of 0.05 px at 6 Hz, over wires).
    """
    exposed_s, commanded_s = ticks["mid_exposure_s"][rows], ticks["time_s"][in_force(ticks)[rows]]
    in_force_s = np.where(commanded_s > exposed_s, np.nan, exposed_s - commanded_s)
    off_s = np.abs(in_force_s - np.nanmedian(in_force_s))
    usual_s = max(_OFF_TIME * period_s, _OFF_SPREAD * np.nanmedian(off_s))
    return np.isnan(off_s) | (off_s <= usual_s)


def periodograms(
    series: Sequence[Series], period_s: float, least_s: float = LEAST_S
) -> Opened | None:
    """Of pieces, each cut into segments of equal length; None if all are shorter than `least_s`."""
    parts: list[tuple[NDArray[Any], ...]] = []
    frames = 0
    inflation = 1.0
    for piece in series:
        count = max(1, round(len(piece.disturbance_px) * period_s / SEGMENT_S))
        length = len(piece.disturbance_px) // count
        if length * period_s < least_s:
            continue
        window = taper(length, TAPERED)
        inflation = float(length * np.sum(window**4) / np.sum(window**2) ** 2)
        own, mirror = (
            _transforms(values, window, count) for values in (piece.disturbance_px, piece.mirror_px)
        )
        scale = 2 * period_s / np.sum(window**2)
        frequency_hz = np.asarray(np.fft.rfftfreq(length, period_s), dtype=float)
        resolution_hz = 1 / (length * period_s)
        # Not at half the frame rate, where a transform is real.
        inside = (frequency_hz >= _FIRST_BINS * resolution_hz) & (
            frequency_hz < 0.5 / period_s - resolution_hz / 4
        )
        ones = np.ones(np.count_nonzero(inside))
        parts.append(
            (
                frequency_hz[inside],
                scale * np.mean(np.abs(own) ** 2, axis=0)[inside],
                scale * np.mean(own * mirror.conj(), axis=0)[inside],
                scale * np.mean(np.abs(mirror) ** 2, axis=0)[inside],
                count * ones,
                _HALF_WIDTH_BINS * resolution_hz * ones,
            )
        )
        frames += length * count
    if not parts:
        return None
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    hz, own_power, cross, mirror_power, segments, half_hz = (column[order] for column in joined)
    return Opened(
        frequency_hz=hz,
        disturbance=own_power,
        cross=cross,
        mirror=mirror_power,
        segments=segments,
        resolution_hz=half_hz,
        period_s=period_s,
        duration_s=frames * period_s,
        inflation=inflation,
    )


def _transforms(values: Floats, window: Floats, count: int) -> NDArray[np.complex128]:
    """Of `count` segments, shape (count, frequencies, axes)."""
    cut = values[: count * len(window)].reshape(count, len(window), -1)
    cut = (cut - cut.mean(axis=1, keepdims=True)) * window[:, None]
    return np.asarray(np.fft.rfft(cut, axis=1))
