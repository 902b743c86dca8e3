"""What the star will do while the next command acts: the part that minimum-variance and fslq share.

What the camera shows is the star's own motion and what the stages did to it. The stages' part is known,
at the frame's own time, so it is subtracted, and a steady-state Kalman filter follows the rest: the air
path, lines of vibrations, and a slow drift. Then a gain for each output makes commands of what is expected.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.disturbance import blocks, disturbance
from fitctl.controllers.design.linear_loop.sampled import timing
from fitctl.controllers.pair import Design, mirror_outputs

Floats = NDArray[np.float64]


class Filter(NamedTuple):
    """Steady-state Kalman filter of the star's own motion.

    Attributes
    ----------
    transition : array, shape (n, n)
        Of air path, lines and drift, over one period.
    gain : array, shape (n,)
        Of a measurement's innovation on the state at its own time.
    seen : array, shape (n,)
        The star's own motion is this of the states.
    """

    transition: Floats
    gain: Floats
    seen: Floats


def star_filter(basis: Basis, drift_px_per_sqrt_s: float) -> Filter:
    """The filter for a loop's air path, lines and noise, with a drift that walks at random."""
    moving = disturbance(basis)
    own, own_noise = moving.over(basis.period_s)
    drift_px2 = drift_px_per_sqrt_s**2 * basis.period_s
    transition = blocks(own, np.ones((1, 1)))
    noise = blocks(own_noise, np.full((1, 1), drift_px2))
    seen = np.append(moving.seen, 1.0)
    variance = basis.noise_px**2
    before = solve_discrete_are(transition.T, seen[:, None], noise, np.array([[variance]]))
    return Filter(transition, before @ seen / (seen @ before @ seen + variance), seen)


class Gains(NamedTuple):
    """How commands follow from what is expected; rows are the outputs of a design.

    Attributes
    ----------
    star : array, shape (outputs, n)
        On the star's own motion at mid-exposure, less target.
    motor : array, shape (outputs,)
        On where the siderostat will be when the command begins.
    memory : array, shape (outputs, n)
        On a memory of the law's own: m+ = keep m + drive @ (mirror, motor step).
    keep, drive : arrays, shapes (n, n), (n, 2)
    """

    star: Floats
    motor: Floats
    memory: Floats
    keep: Floats
    drive: Floats


def predicting_design(
    name: str, basis: Basis, found: Filter, gains: Gains, parameters: dict[str, object]
) -> Design:
    """A pair from a filter and a law.

    States: the star's own motion, expected for the next frame (air path 2, each line 2, drift 1); the
    siderostat steps still under way at mid-exposure, newest first; the law's memory.
    """
    frames, walked = timing(basis.period_s, basis.delay_s)
    own, steps, memory = len(found.gain), frames, len(gains.keep)
    n = own + steps + memory
    # The star's own motion at mid-exposure, once this frame is known: (states, inputs).
    error, _, mirror, motor, target = range(5)
    frame = np.zeros(5)
    frame[[error, target]], frame[[mirror, motor]] = 1.0, -1.0
    now_state = np.zeros((own, n))
    now_state[:, :own] = np.eye(own) - np.outer(found.gain, found.seen)
    now_input = np.outer(found.gain, frame)
    # Where the siderostat will be: where it was at the frame, and the steps that it had not yet made.
    motor_state, motor_input = np.zeros(n), np.eye(5)[motor]
    motor_state[own : own + steps] = 1.0
    motor_state[own + steps - 1] = 1.0 - walked
    # The target counts as a star's own motion the other way, one that stays.
    less_target = now_input.copy()
    less_target[own - 1, target] -= 1.0
    c = gains.star @ now_state + np.outer(gains.motor, motor_state)
    c[:, own + steps :] += gains.memory
    d = gains.star @ less_target + np.outer(gains.motor, motor_input)
    a, b = np.zeros((n, n)), np.zeros((n, 5))
    a[:own], b[:own] = found.transition @ now_state, found.transition @ now_input
    a[own], b[own] = c[1], d[1]
    a[own + 1 : own + steps, own : own + steps - 1] = np.eye(steps - 1)
    a[own + steps :, own + steps :] = gains.keep
    a[own + steps :] += gains.drive @ c[:2]
    b[own + steps :] = gains.drive @ d[:2]
    # So far in the star's true motion; the mirror's input and output count what the rig file says of it.
    moves = mirror_outputs(len(c) - 1)
    c[moves], d[moves] = c[moves] / basis.mirror_gain, d[moves] / basis.mirror_gain
    b[:, mirror], d[:, mirror] = b[:, mirror] * basis.mirror_gain, d[:, mirror] * basis.mirror_gain
    if basis.overshoot:
        a, b, c, d = _with_overshoot(a, b, c, d, basis.overshoot / basis.mirror_gain)
    return Design(
        name=name,
        period_s=basis.period_s,
        delay_s=basis.delay_s,
        a=a,
        b=b,
        c=c,
        d=d,
        hysteresis_inverse=True,
        parameters=parameters,
    )


def _with_overshoot(
    a: Floats, b: Floats, c: Floats, d: Floats, overshoot: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """The same pair for a mirror that is beyond its last step; one more state: the last frame's mirror."""
    mirror = 2
    n = len(a)
    a, c = np.pad(a, ((0, 1), (0, 1))), np.pad(c, ((0, 0), (0, 1)))
    b, d = np.pad(b, ((0, 1), (0, 0))), d.copy()
    a[:, n], c[:, n] = -overshoot * b[:, mirror], -overshoot * d[:, mirror]
    b[:, mirror], d[:, mirror] = (1 + overshoot) * b[:, mirror], (1 + overshoot) * d[:, mirror]
    b[n, mirror] = 1.0
    return a, b, c, d
