"""One stellar loop's hardware, both axes (Fig. 8), advanced lazily to any time in exact steps.

Siderostat motors -> backlash -> beam; stack volts -> hysteresis -> mirror -> modes -> beam; air path;
star -> spots on the focal plane. A leading axis batches independent runs, each with a seed of its own:
a run's result does not depend on which others are beside it, nor on how the time is cut into calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, ConfigError, Rig
from fitctl.model import air_path, hysteresis, structure
from fitctl.model.kernels import compiled_advance
from fitctl.model.optics import mirror_from_stacks, scales

Floats = NDArray[np.float64]
_NOISE_BLOCK_STEPS = 512


@dataclass
class PlantState:
    """Everything that the plant remembers; arrays have the run axis first.

    Attributes
    ----------
    motor_rad, motor_rad_s : shape (runs, 2)
        Siderostat motor angles and rates.
    beam_motor_rad : shape (runs, 2)
        Motor angles as the siderostat's mirror shows them, behind the backlash.
    plays_v : shape (runs, 3, elements)
        Play operators of the three stacks.
    modes : shape (runs, 2, 2)
        Position and rate of each structural mode.
    air : shape (runs, spots, 2, 2)
        Air path of each spot and axis: motion in pixels and its rate. The first is what all spots
        share; the others are what each has besides.
    """

    motor_rad: Floats
    motor_rad_s: Floats
    beam_motor_rad: Floats
    plays_v: Floats
    modes: Floats
    air: Floats


@dataclass
class PlantInputs:
    """What the devices do to the plant: motor velocities, shape (runs, 2), and stack volts, (runs, 3)."""

    velocity_rad_s: Floats
    stack_v: Floats


@dataclass(frozen=True)
class PlantConstants:
    """Numbers of one step; all arrays, so that compiled and reference steps read the same."""

    step_s: float
    amplifier_decay: float
    amplifier_lag_s: float
    backlash_half_rad: float
    play_half_v: Floats
    play_gain_m_per_v: Floats
    bias_v: float
    mid_stroke_m: float
    stack_radius_m: float
    mode_shape: Floats
    mode_transition: Floats
    mode_gain: Floats
    participation: float
    air_transition: Floats
    air_noise: Floats
    air_relative: float
    motor_px_per_rad: float
    mirror_px_per_rad: float
    spot_origin_px: Floats = field(repr=False)


AdvanceKernel = Callable[[PlantConstants, PlantState, PlantInputs, Floats, Floats], None]


def plant_constants(rig: Rig, loop_name: str, star_offset_px: Floats) -> PlantConstants:
    """Numbers of one step of a rig's loop; `star_offset_px` has shape (runs, 2).

    Raises
    ------
    ConfigError
        If no stack has the hysteresis that the rig asks for.
    """
    truth, _ = rig.mock_parts()
    loop, plant = rig.loops[loop_name], truth.loops[loop_name]
    scale = scales(rig, loop)
    lag_s = 1 / (2 * np.pi * plant.amplifier_bandwidth_hz)
    try:
        gains = hysteresis.stack_gains(plant.hysteresis, loop.fsm)
    except ValueError as error:
        msg = f"plant.loops.{loop_name}.hysteresis: {error}"
        raise ConfigError(msg) from None
    half_v = hysteresis.half_widths_v(plant.hysteresis)
    transition, gain = structure.mode_matrices(plant.structure, truth.step_s)
    air_transition, air_noise = air_path.step_matrices(plant.air_path, truth.step_s)
    target = np.array([loop.target_px.az, loop.target_px.el])
    spot_offset = np.array([[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots])
    backlash_rad = plant.backlash_sky_arcsec / ARCSEC_PER_RAD / scale.motor_sky_rad_per_rad
    air_rms_px = air_path.rms_px(plant.air_path)
    return PlantConstants(
        step_s=truth.step_s,
        amplifier_decay=float(np.exp(-truth.step_s / lag_s)),
        amplifier_lag_s=lag_s,
        backlash_half_rad=backlash_rad / 2,
        play_half_v=half_v,
        play_gain_m_per_v=gains,
        bias_v=loop.fsm.bias_v,
        # Where a stack rests that came up from zero to its bias: taken as the mirror's zero.
        mid_stroke_m=float(gains @ np.maximum(loop.fsm.bias_v - half_v, 0.0)),
        stack_radius_m=loop.fsm.stack_radius_m,
        mode_shape=structure.mode_shapes(plant.structure),
        mode_transition=transition,
        mode_gain=gain,
        participation=plant.structure.participation,
        air_transition=air_transition,
        air_noise=air_noise,
        air_relative=plant.air_path.relative_rms_px / air_rms_px if air_rms_px > 0 else 0.0,
        motor_px_per_rad=scale.motor_px_per_rad,
        mirror_px_per_rad=scale.mirror_px_per_rad,
        spot_origin_px=target + star_offset_px[:, None, :] + spot_offset,
    )


def advance_reference(
    constants: PlantConstants,
    state: PlantState,
    inputs: PlantInputs,
    noise: Floats,
    trace_px: Floats,
) -> None:
    """Advance by as many steps as `trace_px` has, in NumPy; the compiled kernels are held to this.

    Parameters
    ----------
    noise : array, shape (steps, runs, spots, 2, 2)
        Standard normal.
    trace_px : array, shape (steps, runs, spots, 2)
        Receives the spots' positions after each step.
    """
    c = constants
    plays = hysteresis.play(state.plays_v, inputs.stack_v[..., None], c.play_half_v)
    displacement_m = hysteresis.hysteresis_output(plays, c.play_gain_m_per_v) - c.mid_stroke_m
    mirror_rad = mirror_from_stacks(displacement_m, c.stack_radius_m)
    mode_input = mirror_rad @ c.mode_shape.T
    static_rad = (1 - c.participation) * mirror_rad
    for step in range(trace_px.shape[0]):
        lead_rad_s = state.motor_rad_s - inputs.velocity_rad_s
        state.motor_rad = (
            state.motor_rad
            + inputs.velocity_rad_s * c.step_s
            + lead_rad_s * c.amplifier_lag_s * (1 - c.amplifier_decay)
        )
        state.motor_rad_s = inputs.velocity_rad_s + lead_rad_s * c.amplifier_decay
        state.beam_motor_rad = hysteresis.play(
            state.beam_motor_rad, state.motor_rad, np.asarray(c.backlash_half_rad)
        )
        state.modes = (
            np.einsum("mij,rmj->rmi", c.mode_transition, state.modes)
            + c.mode_gain * mode_input[..., None]
        )
        moving_rad = static_rad + c.participation * state.modes[..., 0] @ c.mode_shape
        state.air = state.air @ c.air_transition.T + noise[step] @ c.air_noise.T
        own_px = state.air[..., 0] * c.air_relative
        own_px[:, 0] = 0.0
        trace_px[step] = (
            c.spot_origin_px
            + own_px
            + (
                state.air[:, 0, :, 0]
                + c.motor_px_per_rad * state.beam_motor_rad
                + c.mirror_px_per_rad * moving_rad
            )[:, None, :]
        )
    state.plays_v = plays


class Plant:
    """The hardware of one stellar loop for a batch of runs.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` section.
    loop_name : str
    seeds : sequence of int
        One for each run; everything random in a run follows from its seed.
    kernel : callable, optional
        :func:`advance_reference` or a compiled one; by default compiled where numba is installed.
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
        kernel: AdvanceKernel | None = None,
        star_offset_px: Floats | None = None,
        history_s: float | None = None,
    ) -> None:
        truth, _ = rig.mock_parts()
        plant = truth.loops[loop_name]
        children = [np.random.SeedSequence(seed).spawn(3) for seed in seeds]
        self._air_random = [np.random.default_rng(child[0]) for child in children]
        self.frame_random = [np.random.default_rng(child[1]) for child in children]
        if star_offset_px is None:
            star_offset_px = np.array(
                [_place_star(rig, loop_name, np.random.default_rng(child[2])) for child in children]
            )
        self.constants = plant_constants(rig, loop_name, star_offset_px)
        self.seeds = tuple(seeds)
        self._kernel = kernel or compiled_advance() or advance_reference
        runs, spots = len(seeds), len(plant.spots)
        elements = len(plant.hysteresis.breakpoints_v)
        initial = np.linalg.cholesky(
            # The least that lets still air, whose covariance is zero, through.
            air_path.stationary_covariance(plant.air_path) + 1e-300 * np.eye(2)
        )
        self.state = PlantState(
            motor_rad=np.zeros((runs, 2)),
            motor_rad_s=np.zeros((runs, 2)),
            beam_motor_rad=np.zeros((runs, 2)),
            plays_v=np.zeros((runs, 3, elements)),
            modes=np.zeros((runs, 2, 2)),
            air=np.stack([g.standard_normal((spots, 2, 2)) for g in self._air_random]) @ initial.T,
        )
        self.inputs = PlantInputs(
            velocity_rad_s=np.zeros((runs, 2)),
            stack_v=np.full((runs, 3), self.constants.bias_v),
        )
        self._noise = np.empty((_NOISE_BLOCK_STEPS, runs, spots, 2, 2))
        self._noise_used = _NOISE_BLOCK_STEPS
        self._steps = 0
        kept_s = truth.history_s if history_s is None else history_s
        self._trace_px = np.empty((max(1, round(kept_s / truth.step_s)), runs, spots, 2))

    @property
    def time_s(self) -> float:
        """The plant's own time; it starts at zero."""
        return self._steps * self.constants.step_s

    @property
    def oldest_s(self) -> float:
        """The earliest time that the history still holds."""
        return max(1, self._steps - len(self._trace_px) + 1) * self.constants.step_s

    def advance(self, time_s: float) -> None:
        """Go on to the grid time nearest to `time_s`; a time already reached changes nothing."""
        missing = round(time_s / self.constants.step_s) - self._steps
        while missing > 0:
            if self._noise_used == _NOISE_BLOCK_STEPS:
                self._draw_noise()
            row = self._steps % len(self._trace_px)
            count = min(missing, _NOISE_BLOCK_STEPS - self._noise_used, len(self._trace_px) - row)
            self._kernel(
                self.constants,
                self.state,
                self.inputs,
                self._noise[self._noise_used : self._noise_used + count],
                self._trace_px[row : row + count],
            )
            self._noise_used += count
            self._steps += count
            missing -= count

    def spots_px(self, time_s: float) -> Floats:
        """Spot positions at the grid time nearest to `time_s`, shape (runs, spots, 2).

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        self.advance(time_s)
        step = max(1, round(time_s / self.constants.step_s))
        self._advance_to_first_step()
        if step <= self._steps - len(self._trace_px):
            msg = f"the plant's history begins at {self.oldest_s:.3f} s, asked for {time_s:.3f} s"
            raise ValueError(msg)
        return self._trace_px[(step - 1) % len(self._trace_px)]

    def history_px(self, start_s: float, end_s: float) -> Floats:
        """All spot positions from `start_s` to `end_s` on the grid, shape (steps, runs, spots, 2).

        What is older than the history, or not yet reached, is left out.
        """
        step_s = self.constants.step_s
        last = round(min(end_s, self.time_s) / step_s)
        oldest = self._steps - len(self._trace_px) + 1
        first = max(1, oldest, round(min(start_s, self.time_s + step_s) / step_s))
        return self._trace_px[(np.arange(first, last + 1) - 1) % len(self._trace_px)]

    def _advance_to_first_step(self) -> None:
        if self._steps == 0:
            self.advance(self.constants.step_s)

    def _draw_noise(self) -> None:
        # One draw for each run, so that a run is the same whichever others are beside it.
        shape = (_NOISE_BLOCK_STEPS, *self._noise.shape[2:])
        for run, random in enumerate(self._air_random):
            self._noise[:, run] = random.standard_normal(shape)
        self._noise_used = 0


def _place_star(rig: Rig, loop_name: str, random: np.random.Generator) -> Floats:
    """A place uniform over the disc of the rig's largest star offset, in pixels from the target."""
    truth, _ = rig.mock_parts()
    largest = truth.loops[loop_name].star_offset_sky_arcsec_max
    radius_arcsec = largest * np.sqrt(random.uniform())
    angle = random.uniform(0, 2 * np.pi)
    arcsec_per_px = scales(rig, rig.loops[loop_name]).sky_arcsec_per_px
    return np.array([np.cos(angle), np.sin(angle)]) * radius_arcsec / arcsec_per_px
