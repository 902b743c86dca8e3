"""Both stages in one problem: frequency-shaped linear-quadratic control, the paper's alternative [5].

One performance index over the error and over both stages, whose weights depend on frequency: the mirror
is penalised at low frequency, the siderostat at high frequency, and they cross where the work changes
hands. Method: N. K. Gupta, J. Guidance and Control 3, 529 (1980).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fitctl.controllers.design.basis import Basis, design_parameters
from fitctl.controllers.design.linear_loop.disturbance import disturbance, hold
from fitctl.controllers.design.predictor import Gains, predicting_design, star_filter
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]


def design_fslq(basis: Basis) -> Design:
    """Minimise the mean of e^2 + w^2 (|w_c / (jw + w_c) mirror|^2 + |jw / w_c siderostat|^2).

    e is the star's error over the hold, w the control weight, w_c the crossover. The states are the
    mirror's low-passed motion and the siderostat; the star's own motion drives them and is not driven.
    """
    settings = basis.settings.fslq
    found = star_filter(basis, settings.drift_px_per_sqrt_s)
    acts = hold(disturbance(basis), basis.period_s, basis.delay_s)
    crossover_rad_s = 2 * math.pi * settings.crossover_hz
    keep = math.exp(-crossover_rad_s * basis.period_s)
    state = np.diag([keep, 1.0])
    drive = np.diag([1.0 - keep, 1.0])
    # Each row is one thing whose square counts: the error at each node of the hold, the mirror's slow
    # motion, the siderostat's quick motion; as it follows from states, controls and star.
    root = np.sqrt(acts.weight)[:, None]
    one = np.ones_like(acts.part)
    by_state, by_control = np.zeros((len(one) + 2, 2)), np.zeros((len(one) + 2, 2))
    by_star = np.zeros((len(one) + 2, len(found.seen)))
    by_state[:-2] = root * np.column_stack([0 * one, one])
    by_control[:-2] = root * np.column_stack([one, acts.part])
    by_star[:-2] = root * np.column_stack([acts.star, one])
    by_state[-2, 0] = settings.control_weight
    by_control[-1, 1] = settings.control_weight / (crossover_rad_s * basis.period_s)
    gain, star_gain = regulator(state, drive, found.transition, by_state, by_control, by_star)
    gains = Gains(
        star=-star_gain,
        motor=-gain[:, 1],
        memory=-gain[:, :1],
        keep=np.array([[keep]]),
        drive=np.array([[1.0 - keep, 0.0]]),
    )
    return predicting_design("fslq", basis, found, gains, design_parameters(basis, "fslq"))


def regulator(
    state: Floats,
    drive: Floats,
    disturbance: Floats,
    by_state: Floats,
    by_control: Floats,
    by_disturbance: Floats,
) -> tuple[Floats, Floats]:
    """LQ gains on a state, x+ = A x + B u, and on a disturbance, d+ = S d, that enters the cost alone.

    The cost is the sum of squares of Cx x + Cu u + Cd d. S may have eigenvalues on the unit circle, which
    no control reaches and which a Riccati equation for all states would refuse: its block between x
    and d is a linear equation, solved apart.

    Returns
    -------
    on_state, on_disturbance : arrays
        u = -on_state x - on_disturbance d.
    """
    weight = by_control.T @ by_control
    cross = by_state.T @ by_control
    value = solve_discrete_are(state, drive, by_state.T @ by_state, weight, s=cross)
    total = weight + drive.T @ value @ drive
    on_state = np.linalg.solve(total, drive.T @ value @ state + cross.T)
    closed = state - drive @ on_state
    # shared = closed' shared S + left: column by column, one linear system.
    left = by_state.T @ by_disturbance - on_state.T @ by_control.T @ by_disturbance
    system = np.eye(left.size) - np.kron(closed.T, disturbance.T)
    shared = np.linalg.solve(system, left.ravel()).reshape(left.shape)
    on_disturbance = np.linalg.solve(
        total, drive.T @ shared @ disturbance + by_control.T @ by_disturbance
    )
    return on_state, on_disturbance
