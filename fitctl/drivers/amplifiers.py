"""What the siderostat's amplifiers have in common where they are no more than velocity commands and angles."""

from __future__ import annotations

import math

from fitctl.drivers.interface import AzEl

DEVICE = "siderostat amplifiers"
"""What errors call the device."""
AXES = ("azimuth", "elevation")

SLACK = 1.5
"""Factor on what a motor can turn between two readings at its velocity limit."""
_MARGIN_RAD = 0.05


def held(velocity_rad_s: AzEl, limit_rad_s: float) -> AzEl:
    """Both velocities, held within the motors' limit.

    Raises
    ------
    ValueError
        A velocity is not finite.
    """
    az_rad_s, el_rad_s = velocity_rad_s
    if not (math.isfinite(az_rad_s) and math.isfinite(el_rad_s)):
        msg = f"velocities must be finite numbers of rad/s, not {velocity_rad_s}"
        raise ValueError(msg)
    return (
        max(-limit_rad_s, min(limit_rad_s, az_rad_s)),
        max(-limit_rad_s, min(limit_rad_s, el_rad_s)),
    )


def reach_rad(velocity_limit_rad_s: float, since_s: float) -> float:
    """What a motor can have turned at most in a time: a reading beyond it is a false one."""
    return _MARGIN_RAD + SLACK * velocity_limit_rad_s * since_s
