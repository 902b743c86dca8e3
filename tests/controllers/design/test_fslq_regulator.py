import control
import numpy as np
import pytest
from scipy.linalg import block_diag

from fitctl.controllers.design.fslq import regulator


def test_with_a_stable_disturbance_it_is_the_riccati_solution_for_all_states():
    random = np.random.default_rng(0)
    state, drive = np.array([[0.9, 0.1], [0.0, 1.0]]), random.standard_normal((2, 2))
    disturbance = np.array([[0.8, 0.2], [-0.1, 0.7]])
    by_state, by_control, by_disturbance = (random.standard_normal((6, 2)) for _ in range(3))
    on_state, on_disturbance = regulator(
        state, drive, disturbance, by_state, by_control, by_disturbance
    )
    everything = np.hstack([by_state, by_disturbance])
    gain, *_ = control.dlqr(
        block_diag(state, disturbance),
        np.vstack([drive, np.zeros((2, 2))]),
        everything.T @ everything,
        by_control.T @ by_control,
        everything.T @ by_control,
    )
    assert np.hstack([on_state, on_disturbance]) == pytest.approx(gain, abs=1e-8)


def test_a_disturbance_that_stays_is_undone_by_the_stage_that_costs_nothing_at_rest():
    """One integrating stage, one of weight: a constant d of 1 ends with the first at -1."""
    state, drive, disturbance = np.diag([1.0]), np.array([[1.0, 0.0]]), np.eye(1)
    by_state = np.array([[1.0], [0.0], [0.0]])
    by_control = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 0.3]])
    by_disturbance = np.array([[1.0], [0.0], [0.0]])
    on_state, on_disturbance = regulator(
        state, drive, disturbance, by_state, by_control, by_disturbance
    )
    x = np.zeros(1)
    for _ in range(200):
        u = -on_state @ x - on_disturbance @ np.ones(1)
        x = state @ x + drive @ u
    assert x == pytest.approx([-1.0])
    assert u == pytest.approx([0.0, 0.0], abs=1e-9)
