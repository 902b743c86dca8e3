"""Structural modes fitted to a two-axis frequency response."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import find_peaks, peak_widths

from fitctl.identify.errors import IdentifyError

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_LOWEST_FITTED_HZ = 10.0  # below, hysteresis is all there is
_PROMINENCE_DB = 3.0  # a peak less marked is no lightly damped mode
_MOST_MODES = 6
_HANN_BANDWIDTH = 1.5  # bins that share their noise


class Estimate(NamedTuple):
    """A value and its standard deviation, as the fit's residuals have it.

    What the spectra's windows do to a sharp peak is alike in every record, and not in it: about 0.5 % of
    the damping, nothing of the frequency.
    """

    value: float
    std: float

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec}} +- {self.std:.1g}"


class Mode(NamedTuple):
    """One structural mode.

    Attributes
    ----------
    frequency_hz, damping : Estimate
    participation : Estimate
        Part of the mirror's static motion, along the mode, that goes through it.
    angle_rad : Estimate
        Of the mode's direction from the azimuth axis: the cross-axis angle.
    """

    frequency_hz: Estimate
    damping: Estimate
    participation: Estimate
    angle_rad: Estimate

    def __str__(self) -> str:
        return (
            f"{self.frequency_hz:.2f} Hz, damping {self.damping:.4f}, participation "
            f"{self.participation:.3f}, direction {np.degrees(self.angle_rad.value):.1f} +- "
            f"{np.degrees(self.angle_rad.std):.1g} deg from az"
        )


class ModesFit(NamedTuple):
    """A fitted response: see :func:`modes_response`.

    Attributes
    ----------
    modes : tuple of Mode
        Lowest first.
    driven : tuple of int
        Which axes were driven: 0 for az, 1 for el.
    gain : tuple of Estimate
        Of each driven axis, below the modes: hysteresis at this amplitude.
    lag_rad : Estimate
        What hysteresis holds back, at any rate.
    delay_s : Estimate
        Of the bench itself.
    misfit : float
        RMS difference of fit and response, as part of the response.
    """

    modes: tuple[Mode, ...]
    driven: tuple[int, ...]
    gain: tuple[Estimate, ...]
    lag_rad: Estimate
    delay_s: Estimate
    misfit: float


def modes_response(fit: ModesFit, frequency_hz: Floats) -> Complexes:
    """A fit's response, shape (frequencies, 2, driven)."""
    values = [
        *(gain.value for gain in fit.gain),
        fit.lag_rad.value,
        fit.delay_s.value,
        *(estimate.value for mode in fit.modes for estimate in mode),
    ]
    return _response(np.array(values), frequency_hz, fit.driven)


def _response(values: Floats, frequency_hz: Floats, driven: tuple[int, ...]) -> Complexes:
    """H = gain e^(-j lag - s delay) [I + sum_i p_i phi_i phi_i' (G_i - 1)].

    G_i = w_i^2 / (s^2 + 2 zeta_i w_i s + w_i^2), phi_i the mode's direction: at low frequency the axes
    are uncoupled, and what does not go through the modes follows at once.
    """
    gain, (lag_rad, delay_s), modes = np.split(values, [len(driven), len(driven) + 2])
    s = 2j * np.pi * frequency_hz
    shape = np.broadcast_to(np.eye(2, dtype=complex), (len(s), 2, 2)).copy()
    for mode_hz, damping, participation, angle_rad in modes.reshape(-1, 4):
        omega = 2 * np.pi * mode_hz
        moving = omega**2 / (s**2 + 2 * damping * omega * s + omega**2) - 1
        direction = np.array([np.cos(angle_rad), np.sin(angle_rad)])
        shape += participation * moving[:, None, None] * np.outer(direction, direction)
    held_back = np.exp(-1j * lag_rad - s * delay_s)
    return np.asarray(shape[:, :, list(driven)] * held_back[:, None, None] * gain)


def fit_modes(frequency_hz: Floats, response: Complexes, driven: tuple[int, ...]) -> ModesFit:
    """Find the resonances and fit them all at once.

    Parameters
    ----------
    frequency_hz : array, shape (n,)
    response : array, shape (n, 2, driven), complex
    driven : tuple of int
        Which axes were driven.

    Raises
    ------
    IdentifyError
        If there is no resonance, or the fit does not settle.
    """
    used = frequency_hz >= _LOWEST_FITTED_HZ
    frequency_hz, response = frequency_hz[used], response[used]
    size = np.linalg.norm(response, axis=(1, 2))
    first = len(driven) + 2  # where the modes begin
    begin = _begin(frequency_hz, response, size, driven)
    # Each parameter in its own measure.
    scale = np.concatenate(
        [
            np.ones(len(driven)),
            [0.01, 1e-5],
            np.tile([1.0, 0.01, 0.1, 0.1], (len(begin) - first) // 4),
        ]
    )

    def misfit(values: Floats) -> Floats:
        modelled = _response(values, frequency_hz, driven)
        difference = ((modelled - response) / size[:, None, None]).ravel()
        return np.concatenate([difference.real, difference.imag])

    found = least_squares(misfit, begin, x_scale=scale)
    variance = 2 * found.cost / (len(found.fun) - len(begin)) * _HANN_BANDWIDTH
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    estimates = [
        Estimate(float(value), float(std))
        for value, std in zip(found.x, np.sqrt(np.diag(covariance)), strict=True)
    ]
    modes = sorted(
        (_mode(*estimates[i : i + 4]) for i in range(first, len(estimates), 4)),
        key=lambda mode: mode.frequency_hz.value,
    )
    rms = float(np.sqrt(2 * found.cost / len(frequency_hz)))
    if not found.success or rms > 0.5:
        msg = (
            f"response: no modes fit it ({rms:.0%} RMS left over); expected resonances between "
            f"{frequency_hz[0]:.0f} and {frequency_hz[-1]:.0f} Hz; look at coherence and amplitude"
        )
        raise IdentifyError(msg)
    gains, (lag_rad, delay_s) = tuple(estimates[: len(driven)]), estimates[len(driven) : first]
    return ModesFit(tuple(modes), driven, gains, lag_rad, delay_s, rms)


def _mode(frequency_hz: Estimate, damping: Estimate, part: Estimate, angle_rad: Estimate) -> Mode:
    """A mode with its direction within +-90 degrees: a direction and its opposite are the same."""
    within = (angle_rad.value + np.pi / 2) % np.pi - np.pi / 2
    return Mode(frequency_hz, damping, part, Estimate(float(within), angle_rad.std))


def _begin(
    frequency_hz: Floats, response: Complexes, size: Floats, driven: tuple[int, ...]
) -> Floats:
    """Gains from the lowest frequencies; modes from the peaks and, there, the imaginary part."""
    peaks, found = find_peaks(20 * np.log10(size), prominence=_PROMINENCE_DB)
    if len(peaks) == 0:
        msg = (
            f"response: no resonance between {frequency_hz[0]:.0f} and {frequency_hz[-1]:.0f} Hz; "
            f"expected a peak of {_PROMINENCE_DB:g} dB; look at amplitude, coherence and range"
        )
        raise IdentifyError(msg)
    strongest = peaks[np.argsort(-found["prominences"])[:_MOST_MODES]]
    gain = np.abs(response[:20, list(driven), range(len(driven))]).mean(axis=0)
    values = [*gain, 0.0, 0.0]
    # Damping from the width at half the power, of the whole height and not of what stands out of the rest.
    whole = (size[peaks], np.zeros_like(peaks), np.full_like(peaks, len(size) - 1))
    widths, *_ = peak_widths(size, peaks, 1 - np.sqrt(0.5), whole)
    width_hz = dict(zip(peaks, widths * (frequency_hz[1] - frequency_hz[0]), strict=True))
    for peak in np.sort(strongest):
        damping = width_hz[peak] / (2 * frequency_hz[peak])
        # At resonance G = -j / (2 zeta): the imaginary part is p / (2 zeta) phi phi'. Of it, the column
        # that moves most.
        strength = -(response[peak] / gain).imag
        best = int(np.argmax(np.linalg.norm(strength, axis=0)))
        column = strength[:, best]
        power = column @ column / abs(column[driven[best]])
        angle_rad = float(np.arctan2(column[1], column[0]))
        values += [frequency_hz[peak], damping, 2 * damping * power, angle_rad]
    return np.array(values)
