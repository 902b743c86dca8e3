"""One stellar loop's hardware, both axes (Fig. 8), advanced lazily to any time in exact steps.

Siderostat motors -> backlash -> beam; stack volts -> hysteresis -> mirror -> modes -> beam; air path and
vibration lines; star -> spots on the focal plane. The light of a star that comes over a link is also turned by
the link's own siderostat and by the collector bench.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model.compiled import compiled
from fitctl.model.lines import line_kicks, line_motion, line_states
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant_constants import Epoch, plant_constants
from fitctl.model.plant_step import PlantState, PlantTrace, bound_step
from fitctl.model.randomness import place_star, run_randomness
from fitctl.model.timeline import BLOCK_NODES, Air, Part, Timeline, pieces

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
        self._epochs = self.constants.epochs
        self._from_nodes = [epoch.from_node for epoch in self._epochs]
        self._air = Air(
            [(epoch.from_node, epoch.air) for epoch in self._epochs],
            [stream.air for stream in streams],
            self._air_px,
        )
        self._nodes = 0
        self._line_keys = [stream.lines for stream in streams]
        lines = self.constants.beginning_lines
        self._line_states = [line_states(lines, key) for key in self._line_keys]
        self._link, self._collector = link, collector
        self.state = PlantState(runs, len(plant.hysteresis.breakpoints_v))
        self.state.stack_v[:] = self.constants.bias_v
        kept = timeline.kept
        self._trace = PlantTrace(np.empty((kept, runs, spots, 2)), np.empty((kept, runs)))
        self._epoch = 0
        self._step = self._bound_step()

    @property
    def inputs(self) -> PlantState:
        """Where the devices act: its `velocity_rad_s` and `stack_v`, written in place."""
        return self.state

    def begin_block(self) -> None:
        """Draw the air path, and what drives the lines; the star moves."""
        self._air.draw()
        for number, begin, end in pieces(self._from_nodes, self._nodes):
            if len(self._epochs[number].lines):
                self._add_lines(self._epochs[number], begin, end)
        if self.constants.star_rate_px_s.any():
            block = len(self._air_px)
            steps = self._nodes // BLOCK_NODES * block + np.arange(1, block + 1)
            moved_px = np.outer(steps * self.constants.step_s, self.constants.star_rate_px_s)
            self._air_px[:, :, 0] += moved_px[:, None]
        self._nodes += BLOCK_NODES

    def _add_lines(self, epoch: Epoch, begin: int, end: int) -> None:
        """The motion of an epoch's lines over some nodes of the block."""
        step_s, steps = self.constants.step_s, len(self.constants.air.weights)
        first = self._nodes + begin
        since_s = (first - epoch.from_node) * steps * step_s
        rows = slice(begin * steps, end * steps)
        for run, (key, state) in enumerate(zip(self._line_keys, self._line_states, strict=True)):
            compiled(line_motion)(
                epoch.lines,
                state[: len(epoch.lines)],
                line_kicks(key, first, end - begin, len(epoch.lines)),
                since_s,
                steps,
                step_s,
                self._air_px[rows, run, 0],
            )

    def _begin_epoch(self, first: int) -> None:
        """From the step `first` on stacks may have another hysteresis; where they are, they stay."""
        node = first // len(self.constants.air.weights)
        number = bisect_right(self._from_nodes, node) - 1
        if number != self._epoch:
            before, gains = (self._epochs[n].play_gain_m_per_v for n in (self._epoch, number))
            self.state.carried_m[:] += self.state.plays_v @ (before - gains)
            self._epoch = number
            self._step = self._bound_step()

    def _bound_step(self) -> Callable[[int, int], None]:
        gains = self._epochs[self._epoch].play_gain_m_per_v
        return bound_step(self.constants, self.state, self._air_px, self._trace, gains)

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
        if len(self._epochs) > 1:
            self._begin_epoch(first)
        self._step(first, steps)

    def spots_px(self, time_s: float) -> Floats:
        """Spot positions at the grid time nearest to `time_s`, shape (runs, spots, 2).

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        return self.spots_at_px(self._timeline.row(time_s))

    def spots_at_px(self, row: int) -> Floats:
        """Spot positions in a row of the timeline, shape (runs, spots, 2)."""
        return self._trace.spots_px[row]

    def history_px(self, start_s: float, end_s: float) -> Floats:
        """All spot positions from `start_s` to `end_s` on the grid, shape (steps, runs, spots, 2).

        What is older than the history, or not yet reached, is left out.
        """
        return self._trace.spots_px[self._timeline.rows(start_s, end_s)]

    def history_piston_m(self, start_s: float, end_s: float) -> Floats:
        """The mirror's piston (Eq. 4) over the same grid times as :meth:`history_px`, (steps, runs)."""
        return self._trace.piston_m[self._timeline.rows(start_s, end_s)]
