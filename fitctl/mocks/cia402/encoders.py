"""Both encoders as the drive tells them: sampled at one time, in 32 bits, with their velocity."""

from __future__ import annotations

from fitctl.drivers.cia402.protocol import wrap_int32
from fitctl.mocks.motors import FaultyMotors


class Encoders:
    """What the drive has last read of its motors.

    Parameters
    ----------
    motors : FaultyMotors

    Attributes
    ----------
    counts : pair of int
        Both counters as last sampled.
    """

    def __init__(self, motors: FaultyMotors) -> None:
        self.counts = (0, 0)
        self._motors = motors
        self._earlier = self._later = (0.0, self.counts)

    def sample(self) -> None:
        """Read both."""
        az_counts, el_counts = self._motors.position_counts()
        self.counts = (wrap_int32(az_counts), wrap_int32(el_counts))

    def latch(self, now_s: float) -> None:
        """Keep the sample, and its time, for the velocity."""
        self._earlier, self._later = self._later, (now_s, self.counts)

    def velocity_rad_s(self, axis: int) -> float:
        """Mean velocity between the last two samples that were latched."""
        (earlier_s, earlier), (later_s, later) = self._earlier, self._later
        if later_s <= earlier_s:
            return 0.0
        moved = wrap_int32(later[axis] - earlier[axis])
        return moved / (later_s - earlier_s) / self._motors.counts_per_rad
