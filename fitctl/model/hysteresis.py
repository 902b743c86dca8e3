"""Stack hysteresis: 13 play operators in parallel (Eq. 6, Figs. 3-4), a Prandtl-Ishlinskii model.

The model is static and exact and needs no small step: one evaluation is a clamp for each element and a
dot product. Arrays may have any leading axes (runs, stacks).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Fsm, Hysteresis
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]


def gains_from_slopes(slopes_m_per_v: Floats) -> Floats:
    """Eq. 6 inverted: element gains k of the local slopes s = L k of a full-scale ramp.

    Parameters
    ----------
    slopes_m_per_v : array, shape (n,)
        Slopes between the breakpoints, low voltage first.

    Returns
    -------
    array, shape (n,)
        Output gain of each element, metres per volt.
    """
    return np.diff(slopes_m_per_v, prepend=0.0)


def half_widths_v(settings: Hysteresis) -> Floats:
    """Half the deadband width of each element, shape (n,).

    On a ramp from a relaxed (virgin) stack a play begins to follow after half its width; on one that
    comes after a full downward sweep, after all of it.
    """
    breakpoints_v = np.asarray(settings.breakpoints_v)
    return breakpoints_v if settings.breakpoints_from == "virgin" else breakpoints_v / 2


def play(state: Floats, value: Floats, half_width: Floats) -> Floats:
    """One evaluation of the play (backlash) operator: the new output, shapes broadcast."""
    return np.maximum(value - half_width, np.minimum(value + half_width, state))


@compilable(inline=True)
def play_output(plays: Floats, value: float, half_width: Floats, gain: Floats) -> float:
    """Output of parallel plays, shape (n,) each, after they met `value`; they are moved on."""
    total = 0.0
    for element in range(plays.shape[0]):
        half = half_width[element]
        output = max(value - half, min(value + half, plays[element]))
        plays[element] = output
        total += output * gain[element]
    return total


def displacement_series(volts: Floats, half_width_v: Floats, gains: Floats) -> Floats:
    """Displacements of stacks that were relaxed before a series of voltages, as play by play gives them.

    A play limits what it was, and a series of limits is one limit again: what a whole piece of the series does
    follows from playing the two extremes through it. So all pieces are gone through side by side, once for what
    they do and, when it is known where each begins, once more for their output.

    Parameters
    ----------
    volts : array, shape (times, stacks)
    half_width_v : array, shape (n,)
    gains : array, shape (stacks, n)

    Returns
    -------
    array, shape (times, stacks)
        Metres.
    """
    times, stacks = volts.shape
    pieces = math.isqrt(times) + 1
    steps = -(-times // pieces)
    by_step = np.zeros((pieces * steps, stacks))
    by_step[:times] = volts
    by_step = by_step.reshape(pieces, steps, stacks).swapaxes(0, 1)
    low = np.full((pieces, *gains.shape), -np.inf)
    high = -low
    for value in by_step[..., None]:
        low, high = play(low, value, half_width_v), play(high, value, half_width_v)
    state = np.zeros_like(low)
    for piece in range(1, pieces):
        state[piece] = np.clip(state[piece - 1], low[piece - 1], high[piece - 1])
    moved_m = np.empty((steps, pieces, stacks))
    for step, value in enumerate(by_step[..., None]):
        state = play(state, value, half_width_v)
        moved_m[step] = hysteresis_output(state, gains)
    return moved_m.swapaxes(0, 1).reshape(-1, stacks)[:times]


def hysteresis_output(state: Floats, gains: Floats) -> Floats:
    """Displacement of the parallel elements: state has shape (..., n), gains (n,) or (..., n)."""
    return np.vecdot(state, gains)


def raised_displacement(volts: float, half_width_v: Floats, gains: Floats) -> Floats:
    """Displacements of relaxed stacks once raised to a voltage, such as the bias: the virgin curve.

    Parameters
    ----------
    volts : float
    half_width_v : array, shape (n,)
    gains : array, shape (n,) or (stacks, n)

    Returns
    -------
    array, shape () or (stacks,)
        Metres.
    """
    return np.asarray(gains @ np.maximum(volts - half_width_v, 0.0))


def inverse_model(half_width_v: Floats, gains: Floats) -> tuple[Floats, Floats]:
    """The exact inverse operator, metres to volts: itself parallel plays.

    Parameters
    ----------
    half_width_v : array, shape (n,)
        Ascending, the first zero.
    gains : array, shape (..., n)
        All their partial sums (the slopes) positive: otherwise no inverse exists.

    Returns
    -------
    half_width_m, gains_v_per_m : arrays, shape (..., n)

    Notes
    -----
    Krejci and Kuhnen, Inverse control of systems with hysteresis and creep, IEE Proc. Control Theory
    Appl. 148 (2001), Eq. 20-22.
    """
    slopes = np.cumsum(gains, axis=-1)
    half_width_m = slopes * half_width_v - np.cumsum(gains * half_width_v, axis=-1)
    return half_width_m, np.diff(1.0 / slopes, prepend=0.0)


def inverse_state(plays_v: Floats, gains: Floats, slopes: Floats) -> Floats:
    """Plays of the inverse operator, metres, that belong to the model's plays; all of shape (..., n).

    Met with a wanted displacement by :func:`play`, they give by :func:`hysteresis_output` and the inverse
    model's gains the voltage at which stacks with a memory reach it, exactly.

    Parameters
    ----------
    plays_v : array
        As they are now; they are not changed.
    gains, slopes : arrays
        Of the model; slopes are the partial sums of its gains.
    """
    moved_m = np.cumsum(gains * plays_v, axis=-1)
    return slopes * plays_v + moved_m[..., -1:] - moved_m


def swept_stroke(half_width_v: Floats, gains: Floats, full_scale_v: float) -> float:
    """Output swing of a full sweep up and down, once the virgin curve has been left."""
    return float(gains @ np.maximum(full_scale_v - 2 * half_width_v, 0.0))


def swept_loop_width(half_width_v: Floats, gains: Floats, full_scale_v: float) -> float:
    """Vertical width of the full loop at mid scale.

    A play of half width r still rests on its other flank at mid scale when 2r passes half the swing.
    """
    gap = np.minimum(2 * half_width_v, full_scale_v - 2 * half_width_v)
    return float(gains @ np.maximum(gap, 0.0))


def stack_gains(settings: Hysteresis, fsm: Fsm) -> Floats:
    """Element gains of a stack with the rig's stroke and loop width, swept over the D/A's full scale.

    Slopes rise in proportion to the distance between breakpoints, so that the loop bends most where the
    breakpoints are densest; how much they rise sets the loop's width.

    Raises
    ------
    ValueError
        If no such stack exists: the loop is wider than these breakpoints allow.
    """
    half_width_v = half_widths_v(settings)
    full_scale_v = fsm.dac.full_scale_v
    rise = np.diff(half_width_v, prepend=0.0)
    linear = (half_width_v == 0).astype(float)
    # width = fraction * stroke is linear in the strength of the rise.
    fraction = settings.loop_width_fraction
    stroke_linear = swept_stroke(half_width_v, linear, full_scale_v)
    rise_excess = swept_loop_width(half_width_v, rise, full_scale_v) - fraction * swept_stroke(
        half_width_v, rise, full_scale_v
    )
    if rise_excess <= 0:
        msg = f"loop_width_fraction {fraction} is wider than the breakpoints allow; lower it"
        raise ValueError(msg)
    slopes = np.cumsum(linear + rise * (fraction * stroke_linear / rise_excess))
    gains = gains_from_slopes(slopes)
    return gains * settings.full_swing_stroke_m / swept_stroke(half_width_v, gains, full_scale_v)
