"""The tilt between two loops' stars over a run, and the fringe visibility that it leaves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from fitctl.error_budget import LONGEST_GAP_S, regular
from fitctl.figures.attenuation import SEGMENT_S
from fitctl.identify.record import axis_pair
from fitctl.logging.reading import Columns
from fitctl.report.gather import Gathered
from fitctl.report.selection import Selection

Floats = NDArray[np.float64]
_WORST_PERCENT = 5.0  # of the frames have less visibility


class FringeFigures(NamedTuple):
    """Of the frames on which both loops are evaluated; nan without any.

    Attributes
    ----------
    judged_s : float
    tilt_mean_az_arcsec, tilt_mean_el_arcsec : float
        On the sky: the standing part, which an overlap of the fringe spots removes.
    tilt_std_az_arcsec, tilt_std_el_arcsec : float
        About the mean; the camera's noise is in it.
    visibility_mean, visibility_p5 : float
        The mean, and what 5 % of the frames stay below.
    """

    judged_s: float
    tilt_mean_az_arcsec: float
    tilt_mean_el_arcsec: float
    tilt_std_az_arcsec: float
    tilt_std_el_arcsec: float
    visibility_mean: float
    visibility_p5: float


_NOTHING = FringeFigures(0.0, *[math.nan] * 6)


class FringeFindings(NamedTuple):
    """Two loops' stars against each other.

    Attributes
    ----------
    loops : tuple of str
        The tilt is that of the first less that of the second.
    overlap : dict of str to array
        See :class:`fitctl.report.gather.Gathered`.
    rows : array of int
        Of the overlap: the frames on which both loops are evaluated.
    figures : FringeFigures
    frequency_hz : array, shape (frequencies,)
        Above zero; empty where no piece is long enough for a spectrum.
    density : array, shape (frequencies, 2)
        One-sided power spectral density of the tilt in azimuth and elevation, arcsec²/Hz.
    """

    loops: tuple[str, str]
    overlap: Columns
    rows: NDArray[np.intp]
    figures: FringeFigures
    frequency_hz: Floats
    density: Floats


def find_fringes(gathered: Gathered, selections: Mapping[str, Selection]) -> FringeFindings | None:
    """Evaluate the tilt on the frames on which both loops are evaluated; None for a rig without fringes."""
    overlap, settings = gathered.overlap, gathered.run.rig.fringes
    if overlap is None or settings is None:
        return None
    one, other = settings.loops
    period_s = gathered.run.rig.camera.period_s
    counts = ~np.isnan(overlap["visibility"])
    for name in (one, other):
        exposed_s = gathered.ticks[name]["mid_exposure_s"]
        counts &= _within(overlap["time_s"], exposed_s, selections[name], period_s)
    rows = np.flatnonzero(counts)
    tilt_arcsec = axis_pair(overlap, "tilt_{}_arcsec").astype(float)
    figures = _NOTHING
    if len(rows):
        left, tilts = overlap["visibility"][rows], tilt_arcsec[rows]
        mean_arcsec, std_arcsec = tilts.mean(axis=0), tilts.std(axis=0)
        figures = FringeFigures(
            judged_s=len(rows) * period_s,
            tilt_mean_az_arcsec=float(mean_arcsec[0]),
            tilt_mean_el_arcsec=float(mean_arcsec[1]),
            tilt_std_az_arcsec=float(std_arcsec[0]),
            tilt_std_el_arcsec=float(std_arcsec[1]),
            visibility_mean=float(left.mean(dtype=float)),
            visibility_p5=float(np.percentile(left, _WORST_PERCENT)),
        )
    spectrum = density(overlap["time_s"], tilt_arcsec, rows, period_s)
    return FringeFindings((one, other), overlap, rows, figures, *spectrum)


def density(
    time_s: Floats, values: Floats, rows: NDArray[np.intp], period_s: float
) -> tuple[Floats, Floats]:
    """Power spectral density of some rows of a series by Welch's method, their mean removed.

    Parameters
    ----------
    time_s : array, shape (all,)
    values : array, shape (all, n)
    rows : array of int
        Gaps longer than `LONGEST_GAP_S` end a piece; a piece shorter than a segment of 8 s is left out.
    period_s : float
        Of frames.

    Returns
    -------
    frequency_hz : array, shape (frequencies,)
        Above zero; empty without a piece of enough length.
    density : array, shape (frequencies, n)
        One-sided.
    """
    pieces = np.split(rows, np.flatnonzero(np.diff(time_s[rows]) > LONGEST_GAP_S) + 1)
    length = round(SEGMENT_S / period_s)
    weights: list[int] = []
    found: list[Floats] = []
    frequency_hz: Floats = np.empty(0)
    for piece in pieces:
        if len(piece) < 2 or time_s[piece[-1]] - time_s[piece[0]] < SEGMENT_S:
            continue
        series = regular(time_s[piece], values[piece] - values[rows].mean(axis=0), period_s)
        frequency_hz, power = welch(
            series, 1 / period_s, nperseg=min(length, len(series)), detrend=False, axis=0
        )
        found.append(power)
        weights.append(len(series))
    if not found:
        return np.empty(0), np.empty((0, values.shape[1]))
    return frequency_hz[1:], np.average(found, axis=0, weights=weights)[1:]


def _within(
    time_s: Floats, exposed_s: Floats, selection: Selection, period_s: float
) -> NDArray[np.bool_]:
    """Which times lie in a loop's evaluated pieces."""
    inside = np.zeros(len(time_s), bool)
    for piece in selection.pieces:
        begin_s, end_s = exposed_s[piece[[0, -1]]] + np.array([-0.5, 0.5]) * period_s
        inside |= (time_s >= begin_s) & (time_s <= end_s)
    return inside
