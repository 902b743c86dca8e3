"""The tilt between two wavefronts, and the fringe visibility that it leaves.

Two plane waves over a circular aperture of diameter D, tilted by Delta on the sky against each other, leave the
visibility ``|2 J1(x) / x|`` with ``x = pi D Delta / lambda``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

_FAR = 12.0  # below, the power series; from here on, Hankel's expansion
_TERMS = 32
# 2 J1(x) / x = sum of (-x^2/4)^k / (k! (k+1)!), highest power first.
_SERIES = tuple(
    1.0 / (math.factorial(k) * math.factorial(k + 1)) for k in range(_TERMS - 1, -1, -1)
)
# Of Hankel's expansion (Abramowitz and Stegun 9.2.9 and 9.2.10) with mu = 4, in powers of 1 / (8 x).
_HANKEL = tuple(
    math.prod(4 - (2 * j - 1) ** 2 for j in range(1, k + 1)) / math.factorial(k) for k in range(8)
)
_NODES = 64  # of the quadrature, along each axis


def airy_amplitude(x: float) -> float:
    """2 J1(x) / x, which is 1 at x = 0; within 1e-8.

    Without scipy, which a supervisor does not import.
    """
    x = abs(x)
    if x < _FAR:
        square, total = -0.25 * x * x, 0.0
        for term in _SERIES:
            total = total * square + term
        return total
    y = 1.0 / (8.0 * x)
    p = sum((-1) ** k * _HANKEL[2 * k] * y ** (2 * k) for k in range(4))
    q = sum((-1) ** k * _HANKEL[2 * k + 1] * y ** (2 * k + 1) for k in range(4))
    phase = x - 0.75 * math.pi
    j1 = math.sqrt(2.0 / (math.pi * x)) * (p * math.cos(phase) - q * math.sin(phase))
    return 2.0 * j1 / x


def visibility(tilt_rad: float, aperture_m: float, wavelength_m: float) -> float:
    """What a tilt between the wavefronts, as an angle on the sky, leaves of the fringes; 0 to 1."""
    return abs(airy_amplitude(math.pi * aperture_m * tilt_rad / wavelength_m))


def mean_visibility(
    mean_rad: ArrayLike, rms_rad: ArrayLike, aperture_m: float, wavelength_m: float
) -> float:
    """The mean visibility of a tilt that is normally distributed.

    Parameters
    ----------
    mean_rad, rms_rad : array_like, shape (2,)
        Mean and standard deviation along each axis, as angles on the sky.
    aperture_m, wavelength_m : float
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    mean, rms = np.asarray(mean_rad, dtype=float), np.asarray(rms_rad, dtype=float)
    az_rad, el_rad = mean[0] + rms[0] * nodes, mean[1] + rms[1] * nodes
    left = [
        [visibility(math.hypot(az, el), aperture_m, wavelength_m) for el in el_rad.tolist()]
        for az in az_rad.tolist()
    ]
    return float(weights @ np.array(left) @ weights / weights.sum() ** 2)
