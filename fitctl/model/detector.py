"""The optical bench's position-sensing detector: from mirror angles to volts.

Laser light from the mirror goes through a 26.7x compressor and a 200 mm lens onto the detector (paper,
"Hysteresis and Dynamic Coupling").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OPTICAL_GAIN_M_PER_RAD = 2 * 26.7 * 0.200
"""Spot on the detector by mirror angle: the beam turns twice, is magnified, and focused."""
DETECTOR_M_PER_V = 2.0e-4
"""OnTrak PSM with OT-301 amplifier, as calibrated in the paper."""
DETECTOR_RANGE_V = 10.0
"""The amplifier's output ends here, either way (OT-301's data sheet)."""
SAMPLE_RATE_HZ = 12_800.0
"""Of the paper's records: commands and detector alike."""


def detector_volts(mirror_rad: Floats) -> Floats:
    """What the detector gives for mirror angles, shape (..., 2), within its range."""
    return mirror_rad * (OPTICAL_GAIN_M_PER_RAD / DETECTOR_M_PER_V)


def mirror_angles_seen(detector_v: Floats) -> Floats:
    """Mirror angles, shape (..., 2), of detector volts."""
    return detector_v * (DETECTOR_M_PER_V / OPTICAL_GAIN_M_PER_RAD)
