"""One loop's hardware, step by step: its state, and the step in NumPy and compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.model import hysteresis
from fitctl.model.compiled import kernels
from fitctl.model.optics import mirror_from_stacks, piston_m
from fitctl.model.plant_constants import PlantConstants

Floats = NDArray[np.float64]
# One row a run. `stack_v` is what the stacks get, `stacks_at_v` what they have been moved to.
_ROW = np.dtype(
    [
        ("motor_rad", "f8", (2,)),
        ("motor_rad_s", "f8", (2,)),
        ("beam_motor_rad", "f8", (2,)),
        ("modes", "f8", (2, 2)),
        ("velocity_rad_s", "f8", (2,)),
        ("stack_v", "f8", (3,)),
        ("stacks_at_v", "f8", (3,)),
        ("displacement_m", "f8", (3,)),
    ]
)


class PlantState:
    """Everything that the plant remembers but the air, and its inputs; the run axis is first.

    All arrays but the plays are views of one, packed: they are to be written in place.

    Attributes
    ----------
    motor_rad, motor_rad_s : shape (runs, 2)
        Siderostat motor angles and rates.
    beam_motor_rad : shape (runs, 2)
        Motor angles as the siderostat's mirror shows them, behind the backlash.
    modes : shape (runs, 2, 2)
        Position and rate of each structural mode.
    displacement_m : shape (runs, 3)
        Of the stacks, about where they rest at the bias.
    plays_v : shape (runs, 3, elements)
        Play operators of the three stacks.
    velocity_rad_s, stack_v : shapes (runs, 2) and (runs, 3)
        The inputs: motor velocities and stack volts.
    rows : structured array, shape (runs,)
        All of it but the plays.
    """

    def __init__(self, runs: int, elements: int) -> None:
        self.rows = np.zeros(runs, _ROW)
        self.rows["stacks_at_v"] = np.nan  # nowhere yet
        self.motor_rad = self.rows["motor_rad"]
        self.motor_rad_s = self.rows["motor_rad_s"]
        self.beam_motor_rad = self.rows["beam_motor_rad"]
        self.modes = self.rows["modes"]
        self.displacement_m = self.rows["displacement_m"]
        self.velocity_rad_s = self.rows["velocity_rad_s"]
        self.stack_v = self.rows["stack_v"]
        self.plays_v = np.zeros((runs, 3, elements))


class PlantTrace(NamedTuple):
    """What becomes of the steps: spots, shape (rows, runs, spots, 2), and piston, (rows, runs)."""

    spots_px: Floats
    piston_m: Floats


def advance_reference(
    constants: PlantConstants,
    state: PlantState,
    air_px: Floats,
    trace: PlantTrace,
    air_from: int,
    trace_from: int,
    steps: int,
) -> None:
    """Advance in NumPy; the compiled kernel is held to this.

    Parameters
    ----------
    air_px : array, shape (rows, runs, spots, 2)
        Motion that all spots share, then what each further spot has besides, from row `air_from` on.
    trace : PlantTrace
        Receives what the steps lead to, from row `trace_from` on.
    steps : int
    """
    c = constants
    state.plays_v[:] = hysteresis.play(state.plays_v, state.stack_v[..., None], c.play_half_v)
    state.displacement_m[:] = (
        hysteresis.hysteresis_output(state.plays_v, c.play_gain_m_per_v) - c.mid_stroke_m
    )
    mirror_rad = mirror_from_stacks(state.displacement_m, c.stack_radius_m)
    mode_input = mirror_rad @ c.mode_shape.T
    static_rad = (1 - c.participation) * mirror_rad
    trace.piston_m[trace_from : trace_from + steps] = piston_m(
        state.displacement_m, c.stack_radius_m
    )
    for step in range(steps):
        lead_rad_s = state.motor_rad_s - state.velocity_rad_s
        state.motor_rad += state.velocity_rad_s * c.step_s + lead_rad_s * c.amplifier_lag_s * (
            1 - c.amplifier_decay
        )
        state.motor_rad_s[:] = state.velocity_rad_s + lead_rad_s * c.amplifier_decay
        state.beam_motor_rad[:] = hysteresis.play(
            state.beam_motor_rad, state.motor_rad, np.asarray(c.backlash_half_rad)
        )
        state.modes[:] = (
            np.einsum("mij,rmj->rmi", c.mode_transition, state.modes)
            + c.mode_gain * mode_input[..., None]
        )
        moving_rad = static_rad + c.participation * state.modes[..., 0] @ c.mode_shape
        air_now_px = air_px[air_from + step]
        own_px = air_now_px.copy()
        own_px[:, 0] = 0.0
        trace.spots_px[trace_from + step] = (
            c.spot_origin_px
            + own_px
            + (
                air_now_px[:, 0]
                + c.motor_px_per_rad * state.beam_motor_rad @ c.siderostat_turn.T
                + c.mirror_px_per_rad * moving_rad @ c.mirror_turn.T
            )[:, None, :]
        )


def compiled_advance() -> AdvanceKernel | None:
    """The compiled step, or None without numba."""
    compiled = kernels()
    return None if compiled is None else partial(_bind_compiled, compiled.advance)


def bind_reference(
    constants: PlantConstants, state: PlantState, air_px: Floats, trace: PlantTrace
) -> Advance:
    """The step in NumPy, on a plant's own arrays."""
    return partial(advance_reference, constants, state, air_px, trace)


def _bind_compiled(
    kernel: Callable[..., None],
    constants: PlantConstants,
    state: PlantState,
    air_px: Floats,
    trace: PlantTrace,
) -> Advance:
    return partial(
        kernel,
        constants.packed,
        constants.play_half_v,
        constants.play_gain_m_per_v,
        state.rows,
        state.plays_v,
        constants.spot_origin_px,
        air_px,
        *trace,
    )


Advance = Callable[[int, int, int], None]
"""Takes the row of air and of trace to begin at, and how many steps to go on."""
AdvanceKernel = Callable[[PlantConstants, PlantState, Floats, PlantTrace], Advance]
