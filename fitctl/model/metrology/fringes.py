"""What a tilt between two stars' wavefronts leaves of their fringes, for many tilts at once.

The live loop's own is :mod:`fitctl.controllers.visibility`, which needs no scipy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from fitctl.config import Fringes

Floats = NDArray[np.float64]


def mean_visibility(tilt_rad: Floats, fringes: Fringes) -> float:
    """The mean of the visibility over tilts on the sky, shape (n, 2); nan without any."""
    if len(tilt_rad) == 0:
        return math.nan
    x = math.pi * fringes.aperture_m / fringes.wavelength_m * np.hypot(*tilt_rad.T)
    x = np.maximum(x, 1e-9)
    return float(np.mean(np.abs(2 * j1(x) / x)))
