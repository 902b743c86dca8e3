"""Sums over the ticks of one loop: what a line of `fitctl watch` and the counters of the metrics come from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fitctl.logging.records import MetrologyTick, Tick

BEAM_MEASURED = "MEASURED"  # as a metrology tick names the state


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


@dataclass
class BeamTally:
    """Sums over the ticks of one metrology loop since it was made.

    Attributes
    ----------
    ticks, late_ticks : int
        Those whose frame came; those whose command came late.
    samples : int
        Of the photodiodes that measured the beam.
    az_arcsec2, el_arcsec2 : float
        Squared errors of the beam, summed over `samples`.
    newest : MetrologyTick or None
        The last tick, with a frame or without.
    """

    ticks: int = 0
    late_ticks: int = 0
    samples: int = 0
    az_arcsec2: float = 0.0
    el_arcsec2: float = 0.0
    newest: MetrologyTick | None = None

    def add(self, tick: MetrologyTick) -> None:
        """Add one tick."""
        self.newest = tick
        if tick.number >= 0:
            self.ticks += 1
            self.late_ticks += tick.late
        if tick.beam_state == BEAM_MEASURED:
            self.samples += 1
            self.az_arcsec2 += tick.beam_az_arcsec**2
            self.el_arcsec2 += tick.beam_el_arcsec**2

    @property
    def rms_arcsec(self) -> tuple[float, float]:
        """Root mean square of the error, az and el; not-a-number where no beam was measured."""
        if not self.samples:
            return math.nan, math.nan
        return math.sqrt(self.az_arcsec2 / self.samples), math.sqrt(self.el_arcsec2 / self.samples)


def add_beam_ticks(tallies: dict[str, BeamTally], ticks: Iterable[MetrologyTick]) -> None:
    """Give each tick to its loop's tally, which is made where there is none."""
    for tick in ticks:
        tallies.setdefault(tick.loop, BeamTally()).add(tick)


def add_ticks(tallies: dict[str, Tally], ticks: Iterable[Tick]) -> None:
    """Give each tick to its loop's tally, which is made where there is none."""
    for tick in ticks:
        tallies.setdefault(tick.loop, Tally()).add(tick)
