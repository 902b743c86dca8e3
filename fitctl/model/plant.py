"""A rig's whole hardware: every loop's, and the collector bench that couples them.

A leading axis batches independent runs, each with a seed of its own: a run's result does not depend on which
others are beside it, nor, but for rounding, on how the time is cut into calls. Parts are advanced together, in
the order in which one acts on the next: collector, metrology loop, the stellar loop whose light comes over that
link. docs/theory.md derives the coupling.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop, Rig
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.stellar_part import StellarPart
from fitctl.model.timeline import Timeline

Floats = NDArray[np.float64]
_SEEDS_APART = 1000  # of two loops of one run


class Plant(Timeline):
    """The hardware of all loops of a rig for a batch of runs.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` section.
    seeds : sequence of int
        One for each run; everything random in a run follows from its seed.
    star_offset_px : array, shape (runs, 2), optional
        Where each stellar loop's star is at the start, from its target; by default drawn from the seed.
    history_s : float, optional
        How long true positions are kept, by default as the rig says; a large batch wants less.

    Attributes
    ----------
    collector : CollectorPart or None
    stellar_loops, metrology_loops : dict
        Parts by the names of their loops.
    """

    def __init__(
        self,
        rig: Rig,
        seeds: Sequence[int],
        *,
        star_offset_px: Floats | None = None,
        history_s: float | None = None,
    ) -> None:
        truth, _ = rig.mock_parts()
        super().__init__(truth.step_s, truth.history_s if history_s is None else history_s)
        self.collector = None if rig.collector is None else CollectorPart(self, rig.collector)
        self.stellar_loops: dict[str, StellarPart] = {}
        self.metrology_loops: dict[str, MetrologyPart] = {}
        for index, (name, loop) in enumerate(rig.loops.items()):
            own_seeds = [seed + _SEEDS_APART * index for seed in seeds]
            if isinstance(loop, Loop):
                self.stellar_loops[name] = StellarPart(
                    self,
                    rig,
                    name,
                    own_seeds,
                    star_offset_px=star_offset_px,
                    link=None if loop.link is None else self.metrology_loops[loop.link],
                    collector=None if loop.link is None else self.collector,
                )
            else:
                self.metrology_loops[name] = MetrologyPart(
                    self, rig, name, own_seeds, collector=self.collector
                )

    @property
    def loops(self) -> dict[str, StellarPart | MetrologyPart]:
        """All loops' parts by name."""
        return {**self.stellar_loops, **self.metrology_loops}

    def spots_px(self, time_s: float) -> Floats:
        """Spots of all loops on the camera at the grid time nearest to `time_s`, shape (runs, spots, 2)."""
        return np.concatenate(
            [part.spots_px(time_s) for part in self.stellar_loops.values()], axis=1
        )

    @property
    def pixel_key(self) -> int:
        """Of the camera's pixel noise, in the first run."""
        return next(iter(self.stellar_loops.values())).pixel_keys[0]
