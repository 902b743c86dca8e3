"""What a loop's siderostat must undo of what the siderostat of its link turns.

The star's light comes over the link, so that the siderostat that holds the link turns the star as well:
``beta_own += -gain matrix beta_link`` keeps it where it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def link_matrix(
    gain: float, matrix: ArrayLike, link_sky_rad_per_rad: float, own_sky_rad_per_rad: float
) -> Floats:
    """From the motors of the link's siderostat to those of the own one that turn the star as far, shape (2, 2).

    Parameters
    ----------
    gain : float
        0 is no feedforward.
    matrix : array_like, shape (2, 2)
        From the beam of the link's siderostat, az and el on the sky, to the own one's.
    link_sky_rad_per_rad, own_sky_rad_per_rad : float
        Beam on the sky for a radian of each siderostat's motors.
    """
    return gain * link_sky_rad_per_rad / own_sky_rad_per_rad * np.asarray(matrix, dtype=float)
