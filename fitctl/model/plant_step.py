"""One loop's hardware, step by step: its state, and the step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable, compiled, numba_installed
from fitctl.model.hysteresis import play_output
from fitctl.model.optics import turned
from fitctl.model.plant_constants import CREEP_TIMES_S, PlantConstants

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
        ("carried_m", "f8", (3,)),
        ("creep_m", "f8", (3, len(CREEP_TIMES_S))),
        ("crept_m", "f8", (3,)),
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
    carried_m : shape (runs, 3)
        What a changed hysteresis would have moved them by when it changed, had they not stayed.
    creep_m : shape (runs, 3, decades)
        Of each stack: by how much each of its relaxations has crept.
    crept_m : shape (runs, 3)
        Their sum at the last node, which is part of `displacement_m`.
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
        self.carried_m = self.rows["carried_m"]
        self.velocity_rad_s = self.rows["velocity_rad_s"]
        self.stack_v = self.rows["stack_v"]
        self.plays_v = np.zeros((runs, 3, elements))


class PlantTrace(NamedTuple):
    """What becomes of the steps: spots, shape (rows, runs, spots, 2), and piston, (rows, runs)."""

    spots_px: Floats
    piston_m: Floats


@compilable(inline=True)
def move_stacks(c: Any, s: Any, plays_v: Floats, half_v: Floats, gain_m_per_v: Floats) -> None:
    """Take the stacks of one run to their volts. Without a change nothing moves but by creep."""
    for stack in range(3):
        volts = s.stack_v[stack]
        if volts != s.stacks_at_v[stack]:
            s.stacks_at_v[stack] = volts
            output_m = play_output(plays_v[stack], volts, half_v, gain_m_per_v)
            rested_m = output_m - c.mid_stroke_m + s.carried_m[stack]
            s.displacement_m[stack] = rested_m + s.crept_m[stack]


@compilable(inline=True, fused=True)
def step_motor(
    motor_rad: float,
    lead_rad_s: float,
    beam_rad: float,
    moved_rad: float,
    catch_up_s: float,
    decay: float,
    half_rad: float,
) -> tuple[float, float, float]:
    """A step of one axis of a siderostat: its motor behind the amplifier's lag, its mirror behind the backlash.

    `lead_rad_s` is the motor's rate beyond the command, `moved_rad` the way of the command in a step. Returns
    the first three as they are a step later.
    """
    motor_rad += moved_rad + lead_rad_s * catch_up_s
    return (
        motor_rad,
        lead_rad_s * decay,
        max(motor_rad - half_rad, min(motor_rad + half_rad, beam_rad)),
    )


@compilable(inline=True, fused=True)
def step_run(c: Any, s: Any, origin_px: Floats, air_px: Floats, spot_px: Floats) -> None:
    """A step for each row, of one run and its first spot; stacks stand still. Shapes (2,), twice (rows, 2).

    Both axes and modes go side by side: each is a chain of dependent sums, and four run in the time of
    one.
    """
    mirror_az = (s.displacement_m[1] - s.displacement_m[2]) / (2 * c.stack_radius_m)
    mirror_el = (s.displacement_m[0] - s.displacement_m[1]) / (2 * c.stack_radius_m)
    # On the focal plane: what of the mirror does not go through the modes, and each mode's part.
    turned_az, turned_el = turned(c.mirror_turn, mirror_az, mirror_el)
    still_az_px = origin_px[0] + c.mirror_px_per_rad * (1 - c.participation) * turned_az
    still_el_px = origin_px[1] + c.mirror_px_per_rad * (1 - c.participation) * turned_el
    mode_px = c.mirror_px_per_rad * c.participation
    shape_az1, shape_el1 = turned(c.mirror_turn, c.mode_shape[0, 0], c.mode_shape[0, 1])
    shape_az2, shape_el2 = turned(c.mirror_turn, c.mode_shape[1, 0], c.mode_shape[1, 1])
    az_px1, el_px1 = mode_px * shape_az1, mode_px * shape_el1
    az_px2, el_px2 = mode_px * shape_az2, mode_px * shape_el2
    drive1 = mirror_az * c.mode_shape[0, 0] + mirror_el * c.mode_shape[0, 1]
    drive2 = mirror_az * c.mode_shape[1, 0] + mirror_el * c.mode_shape[1, 1]
    a1, b1, c1, d1 = (
        c.mode_transition[0, 0, 0], c.mode_transition[0, 0, 1],
        c.mode_transition[0, 1, 0], c.mode_transition[0, 1, 1],
    )  # fmt: skip
    a2, b2, c2, d2 = (
        c.mode_transition[1, 0, 0], c.mode_transition[1, 0, 1],
        c.mode_transition[1, 1, 0], c.mode_transition[1, 1, 1],
    )  # fmt: skip
    to_place1, to_rate1 = c.mode_gain[0, 0] * drive1, c.mode_gain[0, 1] * drive1
    to_place2, to_rate2 = c.mode_gain[1, 0] * drive2, c.mode_gain[1, 1] * drive2
    place1, rate1 = s.modes[0, 0], s.modes[0, 1]
    place2, rate2 = s.modes[1, 0], s.modes[1, 1]
    decay, half, motor_px = c.amplifier_decay, c.backlash_half_rad, c.motor_px_per_rad
    catch_up_s = c.amplifier_lag_s * (1 - decay)
    command_az, command_el = s.velocity_rad_s[0], s.velocity_rad_s[1]
    moved_az, moved_el = command_az * c.step_s, command_el * c.step_s
    motor_az, lead_az, beam_az = s.motor_rad[0], s.motor_rad_s[0] - command_az, s.beam_motor_rad[0]
    motor_el, lead_el, beam_el = s.motor_rad[1], s.motor_rad_s[1] - command_el, s.beam_motor_rad[1]
    for row in range(spot_px.shape[0]):
        place1, rate1 = to_place1 + b1 * rate1 + a1 * place1, to_rate1 + d1 * rate1 + c1 * place1
        place2, rate2 = to_place2 + b2 * rate2 + a2 * place2, to_rate2 + d2 * rate2 + c2 * place2
        motor_az, lead_az, beam_az = step_motor(
            motor_az, lead_az, beam_az, moved_az, catch_up_s, decay, half
        )
        motor_el, lead_el, beam_el = step_motor(
            motor_el, lead_el, beam_el, moved_el, catch_up_s, decay, half
        )
        turned_az, turned_el = turned(c.siderostat_turn, beam_az, beam_el)
        spot_px[row, 0] = (
            still_az_px + az_px1 * place1 + az_px2 * place2 + motor_px * turned_az
            + air_px[row, 0]
        )  # fmt: skip
        spot_px[row, 1] = (
            still_el_px + el_px1 * place1 + el_px2 * place2 + motor_px * turned_el
            + air_px[row, 1]
        )  # fmt: skip
    s.modes[0, 0], s.modes[0, 1], s.modes[1, 0], s.modes[1, 1] = place1, rate1, place2, rate2
    s.motor_rad[0], s.motor_rad_s[0], s.beam_motor_rad[0] = motor_az, command_az + lead_az, beam_az
    s.motor_rad[1], s.motor_rad_s[1], s.beam_motor_rad[1] = motor_el, command_el + lead_el, beam_el


@compilable()
def creep(c: Any, s: Any, first: int, steps: int) -> None:
    """Let the stacks creep for some steps from `first` on; what has crept shows at the next node.

    Relaxations a decade apart, each of the same part of the way, are a logarithm of time.
    """
    for stack in range(3):
        rested_m = s.displacement_m[stack] - s.crept_m[stack]
        crept_m = 0.0
        for decade in range(s.creep_m.shape[1]):
            wanted_m = c.creep_per_decade * rested_m
            left_m = (s.creep_m[stack, decade] - wanted_m) * c.creep_kept[decade] ** steps
            s.creep_m[stack, decade] = wanted_m + left_m
            crept_m += wanted_m + left_m
        if (first + steps) % c.creep_steps == 0:
            s.crept_m[stack] = crept_m
            s.displacement_m[stack] = rested_m + crept_m


@compilable()
def step_creeping_run(
    c: Any, s: Any, origin_px: Floats, air_px: Floats, spot_px: Floats, piston_m: Floats, first: int
) -> None:
    """:func:`step_run` from the step `first` on with stacks that creep, node by node, and their piston."""
    row, rows = 0, spot_px.shape[0]
    while row < rows:
        end = min(rows, row + c.creep_steps - (first + row) % c.creep_steps)
        step_run(c, s, origin_px, air_px[row:end], spot_px[row:end])
        piston_m[row:end] = stack_piston_m(s)
        creep(c, s, first + row, end - row)
        row = end


@compilable()
def stack_piston_m(s: Any) -> float:
    """Eq. 4: the origin lies midway between stacks 1 and 3, so that it is their mean."""
    return (s.displacement_m[0] + s.displacement_m[2]) / 2


@compilable()
def advance(
    constants: Any,
    play_half_v: Floats,
    play_gain_m_per_v: Floats,
    state: Any,
    plays_v: Floats,
    origin_px: Floats,
    air_px: Floats,
    trace_px: Floats,
    trace_piston_m: Floats,
    first: int,
    steps: int,
) -> None:
    """Advance all runs by some steps; stacks go to their volts first, and stand still but for their creep.

    Parameters
    ----------
    constants, state : one or more rows of PlantConstants.packed and PlantState.rows
        Or, not compiled, what has their fields as attributes.
    play_half_v, play_gain_m_per_v : arrays, shape (elements,)
    plays_v : array, shape (runs, 3, elements)
    origin_px : array, shape (runs, spots, 2)
    air_px : array, shape (rows, runs, spots, 2)
        Motion that all spots share, then what each further spot has besides, filled over and over again.
    trace_px, trace_piston_m : arrays, shape (rows, runs, spots, 2) and (rows, runs)
        Receive what the steps lead to, over and over again.
    first, steps : int
        Number of the first step since the start, and how many; no array may end within them.
    """
    c = constants[0]
    air_from, trace_from = first % air_px.shape[0], first % trace_px.shape[0]
    for run in range(trace_px.shape[1]):
        s = state[run]
        move_stacks(c, s, plays_v[run], play_half_v, play_gain_m_per_v)
        piston_m = trace_piston_m[trace_from : trace_from + steps, run]
        if c.creep_per_decade > 0:
            step_creeping_run(
                c, s, origin_px[run, 0], air_px[air_from : air_from + steps, run, 0],
                trace_px[trace_from : trace_from + steps, run, 0], piston_m, first,
            )  # fmt: skip
        else:
            step_run(
                c, s, origin_px[run, 0], air_px[air_from : air_from + steps, run, 0],
                trace_px[trace_from : trace_from + steps, run, 0],
            )  # fmt: skip
            piston_m[:] = stack_piston_m(s)
        for spot in range(1, trace_px.shape[2]):
            for axis in range(2):
                apart_px = origin_px[run, spot, axis] - origin_px[run, 0, axis]
                for row in range(steps):
                    trace_px[trace_from + row, run, spot, axis] = (
                        trace_px[trace_from + row, run, 0, axis]
                        + apart_px
                        + air_px[air_from + row, run, spot, axis]
                    )


def bound_step(
    constants: PlantConstants,
    state: PlantState,
    air_px: Floats,
    trace: PlantTrace,
    play_gain_m_per_v: Floats | None = None,
    *,
    machine_code: bool | None = None,
) -> Callable[[int, int], None]:
    """:func:`advance` on a plant's own arrays: from a step on, by some steps.

    `play_gain_m_per_v` is in place of the constants' own. Compiled where numba is installed, unless
    `machine_code` is False.
    """
    step: Callable[..., None] = advance
    constant_rows: Any = [constants]
    state_rows: Any = state.rows
    if machine_code if machine_code is not None else numba_installed():
        step, constant_rows = compiled(advance), constants.packed
    else:
        names = state.rows.dtype.names or ()
        state_rows = [SimpleNamespace(**{name: row[name] for name in names}) for row in state.rows]
    gains = constants.play_gain_m_per_v if play_gain_m_per_v is None else play_gain_m_per_v
    plays = constants.play_half_v, gains
    origin_px = constants.spot_origin_px
    return partial(
        step, constant_rows, *plays, state_rows, state.plays_v, origin_px, air_px, *trace
    )
