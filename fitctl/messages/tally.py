"""Sums over the ticks of one loop: what a line of `fitctl watch` and the counters of the metrics come from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fitctl.logging.records import Tick


@dataclass
class Tally:
    """Sums since it was made.

    Attributes
    ----------
    ticks, late_ticks, star_ticks : int
        Ticks with a frame; those whose command came late; those that saw the star.
    az_px2, el_px2 : float
        Squared pointing errors, summed over `star_ticks`.
    newest : Tick or None
        The last tick, with a frame or without.
    """

    ticks: int = 0
    late_ticks: int = 0
    star_ticks: int = 0
    az_px2: float = 0.0
    el_px2: float = 0.0
    newest: Tick | None = None

    def add(self, tick: Tick) -> None:
        """Take one tick."""
        self.newest = tick
        if tick.number < 0:
            return  # no frame came: nothing was measured
        self.ticks += 1
        self.late_ticks += tick.late
        if tick.star_visible:
            self.star_ticks += 1
            self.az_px2 += tick.error_az_px**2
            self.el_px2 += tick.error_el_px**2

    @property
    def rms_px(self) -> tuple[float, float]:
        """Root mean square of the error, az and el; not-a-number where no star was seen."""
        if not self.star_ticks:
            return math.nan, math.nan
        return math.sqrt(self.az_px2 / self.star_ticks), math.sqrt(self.el_px2 / self.star_ticks)


def add_ticks(tallies: dict[str, Tally], ticks: Iterable[Tick]) -> None:
    """Give each tick to its loop's tally, which is made where there is none."""
    for tick in ticks:
        tallies.setdefault(tick.loop, Tally()).add(tick)
