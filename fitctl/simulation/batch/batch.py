"""Many runs of one rig, compiled: the same runs as :mod:`fitctl.simulation.simulation` makes, much quicker."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, ConfigError, Rig
from fitctl.drivers.interface import DeviceError
from fitctl.messages.modes import METROLOGY_MODES, STELLAR_MODES
from fitctl.model.compiled import compiled, numba_installed
from fitctl.model.lines import line_states
from fitctl.model.metrology.fringes import mean_visibility
from fitctl.model.metrology.part import BEAM_CONSTANTS, BeamState, beam_constants, misalignment_rad
from fitctl.model.plant_constants import plant_constants
from fitctl.model.plant_step import PlantState
from fitctl.model.randomness import loop_seeds, place_star, run_randomness
from fitctl.simulation.batch.course import STILL, Course, collector_course
from fitctl.simulation.batch.learning import NO_CHANGES, Changes, changes_of
from fitctl.simulation.batch.records import (
    BEAM,
    BEAM_WORK,
    DESIGN,
    DONE,
    RATE,
    REFUSED_COURSE,
    STAR,
    STAR_WORK,
    of_all_loops,
)
from fitctl.simulation.batch.run import run
from fitctl.simulation.batch.settings import (
    BatchRefusalError,
    beam_settings,
    rig_settings,
    star_settings,
)
from fitctl.simulation.simulation import simulate_rig
from fitctl.simulation.statistics import (
    TILT_EVERY,
    MetrologyResult,
    RigResult,
    SimulationResult,
    of_enough,
    pair,
)

Floats = NDArray[np.float64]
_NOT_YET = np.iinfo(np.int64).max


class LoopRun(NamedTuple):
    """What a run was for one loop.

    Attributes
    ----------
    state : structured array, shape ()
        At the end.
    ticks : structured array, shape (frames,)
        After each frame, if they were kept.
    true : array, shape (steps, 2)
        The true spot in pixels, or the true place of the beam on the photodiodes in metres, likewise.
    """

    state: np.void
    ticks: NDArray[np.void]
    true: Floats


class BatchRun(NamedTuple):
    """A run.

    Attributes
    ----------
    ended : int
        How.
    loops : dict of str to LoopRun
    tilt_px : array, shape (n, 2)
        How far the stars of the fringes were apart.
    changes : Changes
        Which loops that learn made.
    """

    ended: int
    loops: dict[str, LoopRun]
    tilt_px: Floats
    changes: Changes = NO_CHANGES


class Batch:
    """Runs of a rig, one at a time.

    Parameters
    ----------
    rig : Rig

    Raises
    ------
    BatchRefusalError
        Without numba, or if the rig has more of something than the records hold, or something that the batch
        does not model.
    """

    def __init__(self, rig: Rig) -> None:
        if not numba_installed():
            msg = "numba is not installed: pip install 'fitctl[fast]'"
            raise BatchRefusalError(msg)
        self._rig = rig
        self._run = compiled(run)
        truth, _ = rig.mock_parts()
        self._stars = {
            name: plant_constants(rig, name, np.zeros((1, 2))) for name in rig.stellar_loops
        }
        self._beams = {name: beam_constants(rig, name) for name in rig.metrology_loops}
        counts = [len(truth.stellar_loops[name].spots) for name in self._stars]
        self._spots = dict(zip(self._stars, counts, strict=True))
        stars = [
            star_settings(rig, name, constants, sum(counts[:index]))
            for index, (name, constants) in enumerate(self._stars.items())
        ]
        beams = [
            beam_settings(rig, name, constants, sum(counts) + index)
            for index, (name, constants) in enumerate(self._beams.items())
        ]
        self._settings = rig_settings(rig, stars, beams)
        self._learns = any(loop.learn == "on" for loop in rig.stellar_loops.values())
        self._constants = self._room(next(iter(self._stars.values())).packed.dtype, BEAM_CONSTANTS)
        for index, star in enumerate(self._stars.values()):
            self._constants["stars"][0, index] = star.packed[0]
        for index, beam in enumerate(self._beams.values()):
            self._constants["beams"][0, index] = beam.packed[0]
        self._frames_dn = np.empty((2, rig.camera.height_px, rig.camera.width_px))
        self._courses: dict[float, Course] = {}

    def run(
        self,
        seed: int,
        duration_s: float,
        *,
        keep: bool = False,
        changes: Changes | None = None,
    ) -> BatchRun:
        """One run.

        Parameters
        ----------
        seed : int
        duration_s : float
        keep : bool
            Keep every frame's states, and the true places at every step.
        changes : Changes, optional
            By default those that its loops make by themselves, which takes seconds to find out.
        """

        def ticks_with(changes: Changes) -> dict[str, NDArray[np.void]]:
            made = self._run_with(changes, seed, duration_s, keep=True)
            done = made.ended == DONE
            return {name: made.loops[name].ticks for name in self._stars} if done else {}

        if changes is None:
            changes = changes_of(self._rig, ticks_with) if self._learns else NO_CHANGES
        return self._run_with(changes, seed, duration_s, keep=keep)

    def _run_with(self, changes: Changes, seed: int, duration_s: float, *, keep: bool) -> BatchRun:
        """One run with such changes."""
        state, work, plant, air_random = self._beginning(seed)
        try:
            course = self._course(seed, duration_s)
        except (DeviceError, ConfigError):  # the simulation reports what is wrong
            return BatchRun(REFUSED_COURSE, {}, np.empty((0, 2)))
        if changes.rates and course is not STILL:  # it begins at a frame, which comes later then
            return BatchRun(REFUSED_COURSE, {}, np.empty((0, 2)))
        settings = self._settings.copy() if changes.designs else self._settings
        designs = np.array([change.settings for change in changes.designs], DESIGN)
        shared = settings[0]
        frames = math.ceil(duration_s / shared["period_s"]) if keep else 0
        steps = math.ceil((duration_s + 1) / shared["step_s"])
        kept = steps if keep else 0
        stars, beams = len(self._stars), len(self._beams)
        tilts = 0 if self._rig.fringes is None else steps // TILT_EVERY
        tilt_px = np.empty((tilts, 2))
        ticks, samples = np.zeros((frames, stars), STAR), np.zeros((frames, beams), BEAM)
        true_px, beam_m = np.empty((kept, stars, 2)), np.empty((kept, beams, 2))
        ended = self._run(
            settings,
            state,
            work,
            self._constants,
            plant,
            designs,
            np.array(list(changes.rates), RATE),
            tuple(air_random),
            *course,
            *self._frames_dn,
            tilt_px,
            ticks,
            true_px,
            samples,
            beam_m,
            duration_s,
        )
        last = {}
        done = state["stars"][0, 0]["frames"]
        for names, kind, every, true in (
            (self._stars, "stars", ticks, true_px),
            (self._beams, "beams", samples, beam_m),
        ):
            for index, name in enumerate(names):
                r = state[kind][0, index]
                last[name] = LoopRun(r, every[:done, index], true[: r["steps"], index])
        loops = {name: last[name] for name in self._rig.loops}
        return BatchRun(ended, loops, tilt_px[: state["tilts"][0]], changes)

    def _beginning(
        self, seed: int
    ) -> tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void], list[np.random.Generator]]:
        """State, work, the plant's state, and what draws the air, as a run begins."""
        state = self._room(STAR, BEAM, ("tilts", "i8"))
        work = self._room(STAR_WORK, BEAM_WORK)
        plant = self._room(PlantState(1, 0).rows.dtype, BeamState(1).rows.dtype)
        seeds = loop_seeds(self._rig, seed)
        air_random: list[np.random.Generator] = []
        pixel_key = 0
        for index, name in enumerate(self._stars):
            s, r, w = (array["stars"][0, index] for array in (self._settings, state, work))
            streams = run_randomness(seeds[name], self._spots[name])
            place_px = place_star(self._rig, name, streams.place)
            _begin(r)
            r["search_due"] = -1
            # All loops have one camera, whose noise is the first's.
            r["pixel_key"] = pixel_key = pixel_key or streams.pixels
            r["command_px"] = s["target_px"]
            r["stack_v"] = s["bias_v"]
            r["origin_px"] = self._stars[name].spot_origin_px[0, 0] + place_px
            lines, r["line_key"] = self._stars[name].beginning_lines, streams.lines
            w["lines"][: len(lines)] = line_states(lines, streams.lines)
            initial = self._stars[name].air.initial.T
            for spot, random in enumerate(streams.air):
                w["air"][spot] = random.standard_normal((2, 2)) @ initial
            p = plant["stars"][0, index]
            p["stacks_at_v"], p["stack_v"] = np.nan, s["bias_v"]
            air_random += streams.air
        truth, _ = self._rig.mock_parts()
        for index, name in enumerate(self._beams):
            r, w = state["beams"][0, index], work["beams"][0, index]
            streams = run_randomness(seeds[name], 1)
            _begin(r)
            r["noise_key"], r["ticked_s"] = streams.pixels, math.nan
            r["misaligned_rad"] = misalignment_rad(truth.metrology_loops[name], streams.place)
            initial = self._beams[name].air.initial.T
            w["air"][0] = streams.air[0].standard_normal((2, 2)) @ initial
            air_random += streams.air
        return state, work, plant, air_random

    def _room(self, star: np.dtype, beam: np.dtype, *more: tuple[str, str]) -> NDArray[np.void]:
        return of_all_loops(star, len(self._stars), beam, len(self._beams), *more)

    def _course(self, seed: int, duration_s: float) -> Course:
        """What the collector does; only a random course depends on the seed."""
        collector = self._rig.collector
        if collector is None:
            return STILL
        if collector.motion.kind == "random":
            return collector_course(self._rig, seed, duration_s)
        if duration_s not in self._courses:
            self._courses = {duration_s: collector_course(self._rig, 0, duration_s)}
        return self._courses[duration_s]

    def result(self, seed: int, duration_s: float) -> RigResult:
        """One run's result: what :func:`fitctl.simulation.simulation.simulate_rig` gives, but for its speed.

        A run that meets what the batch does not model is simulated.
        """
        run = self.run(seed, duration_s)
        if run.ended != DONE:
            return simulate_rig(self._rig, seed, duration_s)
        loops = {
            name: of_enough(
                self._metrology_result(name, loop.state)
                if name in self._beams
                else _stellar_result(loop.state)
            )
            for name, loop in run.loops.items()
        }
        visibility, fringes = math.nan, self._rig.fringes
        if fringes is not None:
            tilt_rad = run.tilt_px / self._stars[fringes.loops[0]].sky_px_per_rad
            visibility = mean_visibility(tilt_rad, fringes)
        return RigResult(loops, visibility, math.nan)

    def _metrology_result(self, name: str, state: np.void) -> MetrologyResult:
        truth, _ = self._rig.mock_parts()
        length_m = truth.metrology_loops[name].sensor.link_length_m
        rms_m = np.sqrt(_mean(state["true_sum2"], state["residual_steps"]))
        judged_s = float(state["now_s"] - state["residual_from_s"])
        return MetrologyResult(
            acquired_s=float(state["acquired_s"]),
            locked_s=float(state["held_s"]),
            rms_arcsec=pair(rms_m / length_m * ARCSEC_PER_RAD),
            judged_s=judged_s if judged_s > 0 else 0.0,
            mode_times={mode.name: float(state["mode_times_s"][mode]) for mode in METROLOGY_MODES},
            samples=int(state["samples"]),
            speed_x=math.nan,
        )


def _begin(r: np.void) -> None:
    """What a loop of either kind begins with."""
    r["acquired_s"] = r["held_s"] = r["residual_from_s"] = math.nan
    r["residual_from"] = _NOT_YET


def _stellar_result(state: np.void) -> SimulationResult:
    steps, frames = state["residual_steps"], state["residual_frames"]
    piston_m = _mean(state["piston_sum_m"], steps)
    piston_m2 = _mean(state["piston_sum_m2"], steps) - piston_m**2
    judged_s = float(state["now_s"] - state["residual_from_s"])
    return SimulationResult(
        acquired_s=float(state["acquired_s"]),
        vernier_s=float(state["held_s"]),
        rms_px=pair(np.sqrt(_mean(state["true_sum2"], steps))),
        measured_rms_px=pair(np.sqrt(_mean(state["measured_sum_px2"], frames))),
        judged_s=max(0.0, judged_s) if frames else 0.0,
        piston_rms_m=float(np.sqrt(np.maximum(piston_m2, 0.0))),
        mode_times={mode.name: float(state["mode_times_s"][mode]) for mode in STELLAR_MODES},
        frames=int(state["frames"]),
        speed_x=math.nan,
    )


def _mean(total: Floats, count: int) -> Floats:
    return np.asarray(total / count if count else total * math.nan)
