"""A rig's whole hardware: every loop's, and the collector bench that couples them.

A leading axis batches independent runs, each with a seed of its own: a run's result does not depend on which
others are beside it, nor, but for rounding, on how the time is cut into calls. Parts are advanced together, in
the order in which one acts on the next: collector, metrology loop, the stellar loop whose light comes over that
link. docs/theory-testbed.md derives the coupling.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop, Rig
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.randomness import loop_seeds
from fitctl.model.stellar_part import StellarPart
from fitctl.model.timeline import Timeline

Floats = NDArray[np.float64]


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
        self._noises = pixel_noises(rig)
        self._instants_s = exposure_instants_s(rig)
        self.collector = None if rig.collector is None else CollectorPart(self, rig.collector)
        self.stellar_loops: dict[str, StellarPart] = {}
        self.metrology_loops: dict[str, MetrologyPart] = {}
        of_loops = [loop_seeds(rig, seed) for seed in seeds]
        for name, loop in rig.loops.items():
            own_seeds = [of_loop[name] for of_loop in of_loops]
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
        row = self.row(time_s)
        spots_px = [part.spots_at_px(row) for part in self.stellar_loops.values()]
        return spots_px[0] if len(spots_px) == 1 else np.concatenate(spots_px, axis=1)

    def exposure_px(self, middle_s: float) -> Floats:
        """Spots of all loops at all instants of an exposure, shape (runs, instants * spots, 2).

        Those of one instant stand beside each other; the exposure has ended.
        """
        if len(self._instants_s) == 1:
            return self.spots_px(middle_s)
        instants = [self.spots_px(middle_s + apart_s) for apart_s in self._instants_s]
        return np.concatenate(instants, axis=1)

    def pixel_noise_dn(self, time_s: float) -> float:
        """Standard deviation of a dark pixel on a frame exposed at that time."""
        if len(self._noises) == 1:  # every frame asks
            return self._noises[0][1]
        step = round(time_s / self.step_s)
        return next(dn for from_step, dn in reversed(self._noises) if from_step <= step)

    @property
    def pixel_key(self) -> int:
        """Of the camera's pixel noise, in the first run."""
        return next(iter(self.stellar_loops.values())).pixel_keys[0]


def exposure_instants_s(rig: Rig) -> list[float]:
    """When a frame sees the spots, from the middle of its exposure: midway in equal parts of it, on the grid.

    Symmetric, so that what moves evenly is seen where it is in the middle.
    """
    truth, _ = rig.mock_parts()
    count, steps = truth.exposure_instants, rig.camera.exposure_s / truth.step_s
    return [round(steps * ((k + 0.5) / count - 0.5)) * truth.step_s for k in range(count)]


def pixel_noises(rig: Rig) -> list[tuple[int, float]]:
    """The steps from which on the camera's dark pixels have a noise, and that noise in DN."""
    truth, _ = rig.mock_parts()
    changes = [(change.at_s, change.pixel_noise_dn) for change in truth.timeline]
    return [(0, rig.camera.pixel_noise_dn)] + [
        (round(at_s / truth.step_s), dn) for at_s, dn in changes if dn is not None
    ]
