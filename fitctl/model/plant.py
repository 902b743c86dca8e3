"""One stellar loop's hardware, both axes (Fig. 8), advanced lazily to any time in exact steps.

Siderostat motors -> backlash -> beam; stack volts -> hysteresis -> mirror -> modes -> beam; air path;
star -> spots on the focal plane. A leading axis batches independent runs, each with a seed of its own:
a run's result does not depend on which others are beside it, nor, but for rounding, on how the time is
cut into calls.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model import air_path
from fitctl.model.compiled import compiled
from fitctl.model.plant_constants import plant_constants
from fitctl.model.plant_step import PlantState, PlantTrace, bound_step
from fitctl.model.randomness import place_star, run_randomness

Floats = NDArray[np.float64]
BLOCK_NODES = 50  # of the air path, drawn at a time


class Plant:
    """The hardware of one stellar loop for a batch of runs.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` section.
    loop_name : str
    seeds : sequence of int
        One for each run; everything random in a run follows from its seed.
    star_offset_px : array, shape (runs, 2), optional
        Where the star is at the start, from the target; by default drawn from the seed.
    history_s : float, optional
        How long true positions are kept, by default as the rig says; a large batch wants less.
    """

    def __init__(
        self,
        rig: Rig,
        loop_name: str,
        seeds: Sequence[int],
        *,
        star_offset_px: Floats | None = None,
        history_s: float | None = None,
    ) -> None:
        truth, _ = rig.mock_parts()
        plant = truth.stellar_loops[loop_name]
        runs, spots = len(seeds), len(plant.spots)
        streams = [run_randomness(seed, spots) for seed in seeds]
        if star_offset_px is None:
            star_offset_px = np.array([place_star(rig, loop_name, s.place) for s in streams])
        self.constants = plant_constants(rig, loop_name, star_offset_px)
        self._step_s = self.constants.step_s
        self.seeds = tuple(seeds)
        self.pixel_keys = [stream.pixels for stream in streams]
        self._air_random = [stream.air for stream in streams]
        self._air = (
            np.array(
                [
                    [random.standard_normal((2, 2)) for random in stream]
                    for stream in self._air_random
                ]
            )
            @ self.constants.air.initial.T
        )
        self.state = PlantState(runs, len(plant.hysteresis.breakpoints_v))
        self.state.stack_v[:] = self.constants.bias_v
        self._block_steps = BLOCK_NODES * len(self.constants.air.weights)
        self._air_px = np.empty((self._block_steps, runs, spots, 2))
        self._steps = self._room_until = 0
        kept_s = truth.history_s if history_s is None else history_s
        kept = max(1, round(kept_s / truth.step_s))
        self._trace = PlantTrace(np.empty((kept, runs, spots, 2)), np.empty((kept, runs)))
        self._kept = kept
        self._step = bound_step(self.constants, self.state, self._air_px, self._trace)

    @property
    def inputs(self) -> PlantState:
        """Where the devices act: its `velocity_rad_s` and `stack_v`, written in place."""
        return self.state

    @property
    def time_s(self) -> float:
        """The plant's own time; it starts at zero."""
        return self._steps * self.constants.step_s

    @property
    def oldest_s(self) -> float:
        """The earliest time that the history still holds."""
        return max(1, self._steps - self._kept + 1) * self.constants.step_s

    def advance(self, time_s: float) -> None:
        """Go on to the grid time nearest to `time_s`; a time already reached changes nothing."""
        wanted = round(time_s / self._step_s)
        while self._steps < wanted:
            if self._steps == self._room_until:
                self._make_room()
            until = wanted if wanted < self._room_until else self._room_until
            self._step(self._steps, until - self._steps)
            self._steps = until

    def spots_px(self, time_s: float) -> Floats:
        """Spot positions at the grid time nearest to `time_s`, shape (runs, spots, 2).

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        self.advance(time_s)
        step = max(1, round(time_s / self._step_s))
        self._advance_to_first_step()
        if step <= self._steps - self._kept:
            msg = f"the plant's history begins at {self.oldest_s:.3f} s, asked for {time_s:.3f} s"
            raise ValueError(msg)
        return self._trace.spots_px[(step - 1) % self._kept]

    def history_px(self, start_s: float, end_s: float) -> Floats:
        """All spot positions from `start_s` to `end_s` on the grid, shape (steps, runs, spots, 2).

        What is older than the history, or not yet reached, is left out.
        """
        return self._trace.spots_px[self._rows(start_s, end_s)]

    def history_piston_m(self, start_s: float, end_s: float) -> Floats:
        """The mirror's piston (Eq. 4) over the same grid times as :meth:`history_px`, (steps, runs)."""
        return self._trace.piston_m[self._rows(start_s, end_s)]

    def _rows(self, start_s: float, end_s: float) -> NDArray[np.int64]:
        step_s = self.constants.step_s
        last = round(min(end_s, self.time_s) / step_s)
        oldest = self._steps - self._kept + 1
        first = max(1, oldest, round(min(start_s, self.time_s + step_s) / step_s))
        return (np.arange(first, last + 1) - 1) % self._kept

    def _advance_to_first_step(self) -> None:
        if self._steps == 0:
            self.advance(self.constants.step_s)

    def _make_room(self) -> None:
        """For steps up to the end of the air drawn or of the trace, whichever comes first."""
        air_row, trace_row = self._steps % self._block_steps, self._steps % self._kept
        if air_row == 0:
            self._draw_air()
        room = min(self._block_steps - air_row, self._kept - trace_row)
        self._room_until = self._steps + room

    def _draw_air(self) -> None:
        # One draw for each run and spot, so that a run is the same whichever others are beside it.
        air, air_motion = self.constants.air, compiled(air_path.air_motion)
        shape = (BLOCK_NODES, 2, 2)
        for run, randoms in enumerate(self._air_random):
            for spot, random in enumerate(randoms):
                air_motion(
                    self._air[run, spot],
                    random.standard_normal(shape),
                    air.transition,
                    air.noise_gain,
                    air.weights,
                    self._air_px[:, run, spot],
                )
        self._air_px[:, :, 1:] *= air.relative
