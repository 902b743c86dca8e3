"""The plant's step compiled by numba, where numba is installed (extra ``fast``).

It does what :func:`fitctl.model.plant.advance_reference` does, one scalar at a time; a test holds the
two together.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitctl.model.plant import AdvanceKernel, Floats, PlantConstants, PlantInputs, PlantState


@functools.cache
def compiled_advance() -> AdvanceKernel | None:
    """The compiled step, or None without numba. Compiles (or loads its cache) at the first call."""
    try:
        import numba
    except ImportError:
        return None
    try:
        loop: Callable[..., None] = numba.njit(cache=True)(_advance_loop)
    except RuntimeError:  # nowhere to write a cache: it compiles anew each time
        loop = numba.njit(_advance_loop)

    def advance(
        constants: PlantConstants,
        state: PlantState,
        inputs: PlantInputs,
        noise: Floats,
        trace_px: Floats,
    ) -> None:
        c = constants
        loop(
            c.step_s,
            c.amplifier_decay,
            c.amplifier_lag_s,
            c.backlash_half_rad,
            c.play_half_v,
            c.play_gain_m_per_v,
            c.mid_stroke_m,
            c.stack_radius_m,
            c.mode_shape,
            c.mode_transition,
            c.mode_gain,
            c.participation,
            c.air_transition,
            c.air_noise,
            c.air_relative,
            c.motor_px_per_rad,
            c.mirror_px_per_rad,
            c.spot_origin_px,
            state.motor_rad,
            state.motor_rad_s,
            state.beam_motor_rad,
            state.plays_v,
            state.modes,
            state.air,
            inputs.velocity_rad_s,
            inputs.stack_v,
            noise,
            trace_px,
        )

    return advance


def _advance_loop(
    step_s: float,
    amplifier_decay: float,
    amplifier_lag_s: float,
    backlash_half_rad: float,
    play_half_v: Any,
    play_gain: Any,
    mid_stroke_m: float,
    stack_radius_m: float,
    mode_shape: Any,
    mode_transition: Any,
    mode_gain: Any,
    participation: float,
    air_transition: Any,
    air_noise: Any,
    air_relative: float,
    motor_px_per_rad: float,
    mirror_px_per_rad: float,
    spot_origin_px: Any,
    motor_rad: Any,
    motor_rad_s: Any,
    beam_motor_rad: Any,
    plays_v: Any,
    modes: Any,
    air: Any,
    velocity_rad_s: Any,
    stack_v: Any,
    noise: Any,
    trace_px: Any,
) -> None:
    steps, runs, spots, axes = trace_px.shape
    for run in range(runs):
        # Stacks are static: their volts do not change within one call.
        d1 = d2 = d3 = -mid_stroke_m
        for stack in range(3):
            total = 0.0
            for element in range(play_half_v.shape[0]):
                low = stack_v[run, stack] - play_half_v[element]
                high = stack_v[run, stack] + play_half_v[element]
                output = max(low, min(high, plays_v[run, stack, element]))
                plays_v[run, stack, element] = output
                total += output * play_gain[element]
            if stack == 0:
                d1 += total
            elif stack == 1:
                d2 += total
            else:
                d3 += total
        mirror_az = (d2 - d3) / (2 * stack_radius_m)
        mirror_el = (d1 - d2) / (2 * stack_radius_m)
        for step in range(steps):
            moving_az = (1 - participation) * mirror_az
            moving_el = (1 - participation) * mirror_el
            for mode in range(2):
                drive = mirror_az * mode_shape[mode, 0] + mirror_el * mode_shape[mode, 1]
                position, rate = modes[run, mode, 0], modes[run, mode, 1]
                modes[run, mode, 0] = (
                    mode_transition[mode, 0, 0] * position
                    + mode_transition[mode, 0, 1] * rate
                    + mode_gain[mode, 0] * drive
                )
                modes[run, mode, 1] = (
                    mode_transition[mode, 1, 0] * position
                    + mode_transition[mode, 1, 1] * rate
                    + mode_gain[mode, 1] * drive
                )
                moving_az += participation * modes[run, mode, 0] * mode_shape[mode, 0]
                moving_el += participation * modes[run, mode, 0] * mode_shape[mode, 1]
            for axis in range(axes):
                command = velocity_rad_s[run, axis]
                lead = motor_rad_s[run, axis] - command
                motor_rad[run, axis] += command * step_s + lead * amplifier_lag_s * (
                    1 - amplifier_decay
                )
                motor_rad_s[run, axis] = command + lead * amplifier_decay
                beam_motor_rad[run, axis] = max(
                    motor_rad[run, axis] - backlash_half_rad,
                    min(motor_rad[run, axis] + backlash_half_rad, beam_motor_rad[run, axis]),
                )
                moving = moving_az if axis == 0 else moving_el
                shared = motor_px_per_rad * beam_motor_rad[run, axis] + mirror_px_per_rad * moving
                for spot in range(spots):
                    x0, x1 = air[run, spot, axis, 0], air[run, spot, axis, 1]
                    n0, n1 = noise[step, run, spot, axis, 0], noise[step, run, spot, axis, 1]
                    air[run, spot, axis, 0] = (
                        air_transition[0, 0] * x0
                        + air_transition[0, 1] * x1
                        + air_noise[0, 0] * n0
                        + air_noise[0, 1] * n1
                    )
                    air[run, spot, axis, 1] = (
                        air_transition[1, 0] * x0
                        + air_transition[1, 1] * x1
                        + air_noise[1, 0] * n0
                        + air_noise[1, 1] * n1
                    )
                    if spot == 0:
                        shared += air[run, 0, axis, 0]
                        own = 0.0
                    else:
                        own = air[run, spot, axis, 0] * air_relative
                    trace_px[step, run, spot, axis] = spot_origin_px[run, spot, axis] + shared + own
