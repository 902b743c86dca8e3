"""Many runs of one rig, compiled: the same runs as :mod:`fitctl.simulation.simulation` makes, much quicker."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.messages.modes import STELLAR_MODES
from fitctl.model.compiled import compiled, numba_installed
from fitctl.model.plant_constants import plant_constants
from fitctl.model.plant_step import PlantState
from fitctl.model.randomness import place_star, run_randomness
from fitctl.simulation.batch.records import DONE, RUN, WORK
from fitctl.simulation.batch.run import run
from fitctl.simulation.batch.settings import BatchRefusalError, batch_settings
from fitctl.simulation.simulation import simulate
from fitctl.simulation.statistics import SETTLE_S, SimulationResult, pair

Floats = NDArray[np.float64]
_NOT_YET = np.iinfo(np.int64).max


class BatchRun(NamedTuple):
    """A run: its last state, how it ended, and what was kept of the way there."""

    state: np.void
    ended: int
    ticks: NDArray[np.void]
    true_px: Floats


class Batch:
    """Runs of a rig that has one loop, one at a time.

    Parameters
    ----------
    rig : Rig

    Raises
    ------
    BatchRefusalError
        Without numba, or if the rig has more than one loop, more of something than the records hold, or
        something that the batch does not model.
    """

    def __init__(self, rig: Rig) -> None:
        if not numba_installed():
            msg = "numba is not installed: pip install 'fitctl[fast]'"
            raise BatchRefusalError(msg)
        if len(rig.loops) > 1:
            msg = f"it has {len(rig.loops)} loops, and the batch runs rigs of one"
            raise BatchRefusalError(msg)
        (self._name,) = rig.loops
        self._rig = rig
        self._run = compiled(run)
        self._constants = plant_constants(rig, self._name, np.zeros((1, 2)))
        self._settings = batch_settings(rig, self._name, self._constants)
        self._frames_dn = np.empty((2, rig.camera.height_px, rig.camera.width_px))

    def run(self, seed: int, duration_s: float, *, keep: bool = False) -> BatchRun:
        """One run; with `keep`, every frame's state and the true spot at every step are kept."""
        s, c = self._settings[0], self._constants
        spots = int(s["spots"])
        streams = run_randomness(seed, spots)
        place_px = place_star(self._rig, self._name, streams.place)
        state, work = np.zeros(1, RUN), np.zeros(1, WORK)
        state["acquired_s"] = state["vernier_s"] = math.nan
        state["residual_from"] = _NOT_YET
        state["pixel_key"] = streams.pixels
        state["command_px"] = s["target_px"]
        state["stack_v"] = s["bias_v"]
        state["origin_px"] = c.spot_origin_px[0, 0] + place_px
        work["air"][0, :spots] = [
            random.standard_normal((2, 2)) @ c.air.initial.T for random in streams.air
        ]
        plant = PlantState(1, 0)
        plant.stack_v[:] = s["bias_v"]
        frames = math.ceil(duration_s / s["period_s"]) if keep else 0
        steps = math.ceil((duration_s + 1) / c.step_s) if keep else 0
        ticks, true_px = np.zeros(frames, RUN), np.empty((steps, 2))
        ended = self._run(
            self._settings,
            state,
            work,
            c.packed,
            plant.rows,
            tuple(streams.air),
            *self._frames_dn,
            ticks,
            true_px,
            duration_s,
        )
        last = state[0]
        return BatchRun(last, ended, ticks[: last["frames"]], true_px[: last["steps"]])

    def result(self, seed: int, duration_s: float) -> SimulationResult:
        """One run's result: what :func:`fitctl.simulation.simulation.simulate` gives, but for its speed.

        A run that meets what the batch does not model is simulated.
        """
        run = self.run(seed, duration_s)
        if run.ended == DONE:
            return _result(run.state)
        return simulate(self._rig, seed, duration_s)[self._name]


def _result(state: np.void) -> SimulationResult:
    steps, frames = state["residual_steps"], state["residual_frames"]
    start_s = state["vernier_s"] + SETTLE_S
    piston_m = _mean(state["piston_sum_m"], steps)
    piston_m2 = _mean(state["piston_sum_m2"], steps) - piston_m**2
    return SimulationResult(
        acquired_s=float(state["acquired_s"]),
        vernier_s=float(state["vernier_s"]),
        rms_px=pair(np.sqrt(_mean(state["true_sum_px2"], steps))),
        measured_rms_px=pair(np.sqrt(_mean(state["measured_sum_px2"], frames))),
        judged_s=max(0.0, float(state["now_s"] - start_s)) if frames else 0.0,
        piston_rms_m=float(np.sqrt(np.maximum(piston_m2, 0.0))),
        mode_times={mode.name: float(state["mode_times_s"][mode]) for mode in STELLAR_MODES},
        frames=int(state["frames"]),
        speed_x=math.nan,
    )


def _mean(total: Floats, count: int) -> Floats:
    return np.asarray(total / count if count else total * math.nan)
