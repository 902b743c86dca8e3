"""The drive's two motors and encoders: counters that wrap, and what faults make of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from fitctl.drivers.cia402.protocol import wrap_int32
from fitctl.mocks.faults import Faults

PARTS = ("az", "el")


class Motors(Protocol):
    """The plant's side of the drive: azimuth is axis 0, elevation axis 1."""

    def position_rad(self) -> Sequence[float]:
        """Both motors' angles now."""
        ...

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors at these velocities; said again at every SYNC."""
        ...

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give one motor current, or take it away."""
        ...


class Shafts:
    """Both motors as the drive sees them.

    Parameters
    ----------
    motors : Motors
    faults : Faults
        With `encoder_jump` and `stuck_axis` among its kinds.
    counts_per_rad : float

    Attributes
    ----------
    counts : pair of int
        Both counters as last sampled.
    """

    def __init__(self, motors: Motors, faults: Faults, counts_per_rad: float) -> None:
        self.counts = (0, 0)
        self.counts_per_rad = counts_per_rad
        self._motors = motors
        self._faults = faults
        self._zero_rad = (0.0, 0.0)
        self._earlier = self._later = (0.0, (0, 0))

    def sample(self) -> None:
        """Read both encoders."""
        az_rad, el_rad = self._motors.position_rad()
        self.counts = (self._count(0, az_rad), self._count(1, el_rad))

    def latch(self, now_s: float) -> None:
        """Keep the sample, and its time, for the velocity."""
        self._earlier, self._later = self._later, (now_s, self.counts)

    def velocity_rad_s(self, axis: int) -> float:
        """Mean velocity between the last two samples that were latched."""
        (earlier_s, earlier), (later_s, later) = self._earlier, self._later
        if later_s <= earlier_s:
            return 0.0
        moved = wrap_int32(later[axis] - earlier[axis])
        return moved / (later_s - earlier_s) / self.counts_per_rad

    def command(self, velocities_rad_s: Sequence[float]) -> None:
        """Turn both motors, as far as they can turn."""
        az, el = (
            0.0 if self._faults.value("stuck_axis", part) is not None else velocity_rad_s
            for velocity_rad_s, part in zip(velocities_rad_s, PARTS, strict=True)
        )
        self._motors.command_velocity_rad_s(az, el)

    def count_from_here(self) -> None:
        """Power comes back: the counters start at zero, wherever the motors stand."""
        az_rad, el_rad = self._motors.position_rad()
        self._zero_rad = (az_rad, el_rad)

    def _count(self, axis: int, angle_rad: float) -> int:
        counts = math.floor((angle_rad - self._zero_rad[axis]) * self.counts_per_rad + 0.5)
        jump = self._faults.value("encoder_jump", PARTS[axis]) or 0.0
        return wrap_int32(counts + round(jump))
