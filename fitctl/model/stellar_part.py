"""One stellar loop's hardware, both axes (Fig. 8), advanced lazily to any time in exact steps.

Siderostat motors -> backlash -> beam; stack volts -> hysteresis -> mirror -> modes -> beam; air path;
star -> spots on the focal plane. The light of a star that comes over a link is also turned by the link's own
siderostat and by the collector bench.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant_constants import plant_constants
from fitctl.model.plant_step import PlantState, PlantTrace, bound_step
from fitctl.model.randomness import place_star, run_randomness
from fitctl.model.timeline import Air, Part, Timeline

Floats = NDArray[np.float64]


class StellarPart(Part):
    """The hardware of one stellar loop for a batch of runs.

    Parameters
    ----------
    timeline : Timeline
    rig : Rig
        Must have its ``plant`` section.
    loop_name : str
    seeds : sequence of int
        One for each run; everything random in a run follows from its seed.
    star_offset_px : array, shape (runs, 2), optional
        Where the star is at the start, from the target; by default drawn from the seed.
    link : MetrologyPart, optional
        Over which the star's light comes.
    collector : CollectorPart, optional
        From which it comes then.
    """

    def __init__(
        self,
        timeline: Timeline,
        rig: Rig,
        loop_name: str,
        seeds: Sequence[int],
        *,
        star_offset_px: Floats | None = None,
        link: MetrologyPart | None = None,
        collector: CollectorPart | None = None,
    ) -> None:
        super().__init__(timeline)
        truth, _ = rig.mock_parts()
        plant = truth.stellar_loops[loop_name]
        runs, spots = len(seeds), len(plant.spots)
        streams = [run_randomness(seed, spots) for seed in seeds]
        if star_offset_px is None:
            star_offset_px = np.array([place_star(rig, loop_name, s.place) for s in streams])
        self.constants = plant_constants(rig, loop_name, star_offset_px)
        self.seeds = tuple(seeds)
        self.pixel_keys = [stream.pixels for stream in streams]
        self._air_px = np.empty((timeline.block_steps, runs, spots, 2))
        self._air = Air(self.constants.air, [stream.air for stream in streams], self._air_px)
        self._link, self._collector = link, collector
        self.state = PlantState(runs, len(plant.hysteresis.breakpoints_v))
        self.state.stack_v[:] = self.constants.bias_v
        kept = timeline.kept
        self._trace = PlantTrace(np.empty((kept, runs, spots, 2)), np.empty((kept, runs)))
        self._step = bound_step(self.constants, self.state, self._air_px, self._trace)

    @property
    def inputs(self) -> PlantState:
        """Where the devices act: its `velocity_rad_s` and `stack_v`, written in place."""
        return self.state

    def begin_block(self) -> None:
        """Draw the air path."""
        self._air.draw()

    def step(self, first: int, steps: int) -> None:
        """Go on by some steps."""
        if self._link is not None:
            # Whatever turns the light moves all spots as the air path does.
            row = first % len(self._air_px)
            rows = slice(row, row + steps)
            turned_rad = self._link.beam_rad[rows]
            if self._collector is not None:
                turned_rad = turned_rad + self._collector.star_rad[rows, None, :]
            self._air_px[rows, :, 0] += self.constants.sky_px_per_rad * turned_rad
        self._step(first, steps)

    def spots_px(self, time_s: float) -> Floats:
        """Spot positions at the grid time nearest to `time_s`, shape (runs, spots, 2).

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        return self._trace.spots_px[self._timeline.row(time_s)]

    def history_px(self, start_s: float, end_s: float) -> Floats:
        """All spot positions from `start_s` to `end_s` on the grid, shape (steps, runs, spots, 2).

        What is older than the history, or not yet reached, is left out.
        """
        return self._trace.spots_px[self._timeline.rows(start_s, end_s)]

    def history_piston_m(self, start_s: float, end_s: float) -> Floats:
        """The mirror's piston (Eq. 4) over the same grid times as :meth:`history_px`, (steps, runs)."""
        return self._trace.piston_m[self._timeline.rows(start_s, end_s)]
