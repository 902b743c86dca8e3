"""By how much a running loop attenuates its disturbance, measured from its ticks as a log has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from fitctl.config import Fsm, Rig
from fitctl.error_budget import in_force
from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import axis_pair
from fitctl.messages.modes import Mode
from fitctl.model.hysteresis import displacement_series, raised_displacement
from fitctl.model.optics import mirror_angles, mirror_from_stacks, scales
from fitctl.simulation.statistics import SETTLE_S

Floats = NDArray[np.float64]
Ticks = Mapping[str, NDArray[Any]]
SEGMENT_S = 8.0  # 0.125 Hz a bin
BAND_HZ = 0.15  # either side of the frequency asked for
_MOST_MISSING = 0.02  # of the frames


class Rebuilt(NamedTuple):
    """One stretch of VERNIER, frame by frame.

    Attributes
    ----------
    time_s : array, shape (frames,)
        Of mid-exposure.
    error_px : array, shape (frames, 2)
        Centroid less target, as measured.
    disturbance_px : array, shape (frames, 2)
        What it would have been with the stages at rest.
    """

    time_s: Floats
    error_px: Floats
    disturbance_px: Floats


class Spectra(NamedTuple):
    """One-sided power spectral densities of both, px²/Hz, mean of both axes, shape (frequencies,)."""

    frequency_hz: Floats
    error: Floats
    disturbance: Floats


def rebuilt(rig: Rig, loop_name: str, ticks: Ticks) -> Rebuilt:
    """Open the loop again, on paper: the error less where both stages had moved the star at mid-exposure.

    The last stretch of VERNIER counts, from `SETTLE_S` after its start. The mirror is where the rig
    file's hysteresis puts it for the logged stack voltages (Eq. 5 where it is not known), the siderostat
    where its encoders were. What neither shows, backlash and unknown hysteresis, stays in both series.

    Parameters
    ----------
    ticks : mapping of str to array
        All ticks of a log in their order: the stacks remember.

    Raises
    ------
    IdentifyError
        If there is no such stretch, or the star is missing on too many of its frames.
    """
    inside = _last_vernier(ticks)
    exposed_s = ticks["mid_exposure_s"][inside]
    error_px = axis_pair(ticks, "error_{}_px")[inside]
    return Rebuilt(exposed_s, error_px, error_px - stages_px(rig, loop_name, ticks)[inside])


def stages_px(rig: Rig, loop_name: str, ticks: Ticks) -> Floats:
    """Where both stages had moved the star at each tick's mid-exposure, px, shape (ticks, 2).

    Mirror and siderostat as :func:`rebuilt` has them; NaN for a tick without a frame.

    Parameters
    ----------
    ticks : mapping of str to array
        All ticks of a log in their order: the stacks remember.
    """
    loop = rig.stellar_loops[loop_name]
    scale = scales(rig, loop)
    mirror_px = scale.mirror_px(mirror_at_exposure_rad(loop.fsm, ticks))
    motor_px = scale.motor_px(axis_pair(ticks, "siderostat_{}_rad"))
    return np.where(np.isnan(ticks["mid_exposure_s"])[:, None], np.nan, mirror_px + motor_px)


def mirror_at_exposure_rad(fsm: Fsm, ticks: Ticks) -> Floats:
    """Where the mirror was at mid-exposure, by its hysteresis where that is known, shape (ticks, 2)."""
    return _mirror_angles_rad(fsm, ticks)[in_force(ticks)]


def stacks_m(ticks: Ticks, fsm: Fsm, half_widths_v: Floats, gains_m_per_v: Floats) -> Floats:
    """Displacements of the stacks about where they rest at the bias, shape (ticks, 3)."""
    volts = np.stack([ticks[f"stack{n}_v"] for n in (1, 2, 3)], axis=-1, dtype=float)
    moved_m = displacement_series(volts, half_widths_v, gains_m_per_v)
    moved_m -= raised_displacement(fsm.bias_v, half_widths_v, gains_m_per_v)
    return moved_m


def _mirror_angles_rad(fsm: Fsm, ticks: Ticks) -> Floats:
    """After each tick's command, shape (ticks, 2)."""
    known = fsm.hysteresis
    if known is None:
        volts = np.stack([ticks[f"stack{n}_v"] for n in (1, 2, 3)], axis=-1, dtype=float)
        return mirror_angles(volts, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
    half_widths_v, gains = np.asarray(known.half_widths_v), np.asarray(known.gains_m_per_v)
    return mirror_from_stacks(stacks_m(ticks, fsm, half_widths_v, gains), fsm.stack_radius_m)


def _last_vernier(ticks: Ticks) -> NDArray[np.intp]:
    """Frames with a star in the last stretch of VERNIER, once it has settled."""
    vernier = (ticks["mode"] == Mode.VERNIER.name) & (ticks["number"] >= 0)
    entered = np.flatnonzero(np.diff(vernier.astype(int), prepend=0) == 1)
    if len(entered) == 0:
        msg = "attenuation: no frame in VERNIER; record while the star is held"
        raise IdentifyError(msg)
    begin_s = ticks["time_s"][entered[-1]] + SETTLE_S
    counts = vernier & (ticks["time_s"] >= begin_s)
    frames = np.flatnonzero(counts & ticks["star_visible"])
    if len(frames) < max(2, (1 - _MOST_MISSING) * np.count_nonzero(counts)):
        msg = (
            f"attenuation: {len(frames)} usable frames of {np.count_nonzero(counts)} in VERNIER after "
            f"{SETTLE_S:g} s; expected a star on at least {100 * (1 - _MOST_MISSING):g} %; record longer"
        )
        raise IdentifyError(msg)
    return frames


def spectra(series: Rebuilt, period_s: float) -> Spectra:
    """Welch's method with Hann windows, means removed.

    Raises
    ------
    IdentifyError
        If the stretch is shorter than one segment.
    """
    segment = round(SEGMENT_S / period_s)
    if len(series.error_px) < segment:
        msg = (
            f"attenuation: {len(series.error_px) * period_s:.1f} s in VERNIER; expected at least "
            f"{SEGMENT_S:g} s, better a minute; record longer"
        )
        raise IdentifyError(msg)
    options: dict[str, Any] = {"fs": 1 / period_s, "nperseg": segment, "axis": 0}
    frequency_hz, error = welch(series.error_px, **options)
    _, disturbance = welch(series.disturbance_px, **options)
    return Spectra(frequency_hz, error.mean(axis=1), disturbance.mean(axis=1))


def mean_spectra(of_runs: list[Spectra], weights: list[float] | None = None) -> Spectra:
    """The mean over runs, each with its weight; by default all alike."""
    frequency_hz, error, disturbance = zip(*of_runs, strict=True)
    return Spectra(
        frequency_hz[0],
        np.average(error, axis=0, weights=weights),
        np.average(disturbance, axis=0, weights=weights),
    )


def attenuation(measured: Spectra, at_hz: float) -> float:
    """Disturbance over error about a frequency, as amplitudes.

    The centroid noise n needs no subtraction: the rebuilt disturbance is d + n, and the loop, which
    cannot distinguish the two, makes S (d + n) of it, the measured error. To take a white floor off each
    spectrum would be wrong, because in closed loop the star's true motion follows the noise.
    """
    near = np.abs(measured.frequency_hz - at_hz) <= BAND_HZ
    ratio = measured.disturbance[near] / measured.error[near]
    return float(np.exp(np.mean(np.log(ratio)) / 2))
