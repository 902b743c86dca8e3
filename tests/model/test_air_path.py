import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model import plant_references
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.signal import welch

from fitctl.model import air_path
from fitctl.model.air_path import discretize, state_space, stationary_covariance, step_matrices
from fitctl.model.compiled import compiled
from fitctl.model.plant import Plant

steps_s = st.floats(1e-4, 1.0)


@pytest.fixture(scope="module")
def air(rig):
    return rig.plant.loops["right"].air_path


@pytest.fixture(scope="module")
def dynamics(air):
    a, b, _ = state_space(air)
    return a, b @ b.T


def psd_px2_per_hz(air, frequency_hz):
    """One-sided spectrum of Eq. 9 under two-sided white noise of unit intensity."""
    s = 2j * np.pi * frequency_hz
    return 2 * np.abs(air.gain_px / (air.b1_s2 * s**2 + air.b2_s * s + 1)) ** 2


def test_open_loop_motion_is_0_201_px(air):
    assert air_path.rms_px(air) == pytest.approx(0.201, abs=5e-4)


def test_the_spectrum_of_eq_9_holds_the_same_variance(air):
    frequency_hz = np.linspace(0, 200, 400_001)
    variance = np.trapezoid(psd_px2_per_hz(air, frequency_hz), frequency_hz)
    assert math.sqrt(variance) == pytest.approx(air_path.rms_px(air), rel=1e-3)


def test_noise_read_as_a_unit_sequence_at_50_hz_would_be_the_papers_residual_with_control(air):
    a, b, _ = state_space(air)
    held = expm(np.block([[a, b], [np.zeros((1, 3))]]) * 0.02)
    covariance = solve_discrete_lyapunov(held[:2, :2], held[:2, 2:] @ held[:2, 2:].T)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(0.028, abs=5e-4)


# ---------------------------------------------------------------- exact discretization (Van Loan)


def test_van_loan_agrees_with_fine_integration(dynamics):
    a, intensity = dynamics
    step_s, nodes = 0.3, 2000
    fine = expm(a * step_s / nodes)
    power, integrand = np.eye(2), []
    for _ in range(nodes + 1):
        integrand.append(power @ intensity @ power.T)
        power = fine @ power
    transition, covariance = discretize(a, intensity, step_s)
    assert transition == pytest.approx(np.linalg.matrix_power(fine, nodes), rel=1e-9)
    integral = np.trapezoid(np.array(integrand), dx=step_s / nodes, axis=0)
    assert covariance == pytest.approx(integral, rel=1e-5)
    # scipy refuses what is not symmetric.
    assert np.array_equal(covariance, covariance.T)


@given(step_s=steps_s)
def test_two_half_steps_are_one_step(dynamics, step_s):
    whole, covariance = discretize(*dynamics, step_s)
    half, half_covariance = discretize(*dynamics, step_s / 2)
    assert half @ half == pytest.approx(whole, rel=1e-9, abs=1e-12)
    twice = half @ half_covariance @ half.T + half_covariance
    assert twice == pytest.approx(covariance, rel=1e-9, abs=1e-12)


@given(step_s=steps_s)
def test_a_step_keeps_the_stationary_covariance(air, step_s):
    transition, gain = step_matrices(air, step_s)
    covariance = stationary_covariance(air)
    after = transition @ covariance @ transition.T + gain @ gain.T
    assert after == pytest.approx(covariance, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("b1_s2", [3e-3, 1e-3, 1e-5])
def test_a_pole_that_decays_within_the_step_costs_no_digits(air, b1_s2):
    """As it was found: the bound of such air was 31 px at the frames, or no number at all."""
    fast = air.model_copy(update={"b1_s2": b1_s2})
    transition, gain = step_matrices(fast, 0.035)
    covariance = stationary_covariance(fast)
    after = transition @ covariance @ transition.T + gain @ gain.T

    assert after == pytest.approx(covariance, rel=1e-6, abs=1e-9)


def test_the_noise_gain_is_a_root_of_the_step_covariance(air, dynamics):
    for step_s in (1e-6, 5e-4, 0.02):
        _, gain = step_matrices(air, step_s)
        _, covariance = discretize(*dynamics, step_s)
        assert gain @ gain.T == pytest.approx(covariance, rel=1e-6, abs=1e-15)


# ---------------------------------------------------------------- between nodes


def test_the_cubic_meets_motion_and_rate_at_both_nodes():
    steps, step_s = 10, 5e-4
    weights = air_path.bridge_weights(steps, step_s)
    cubic = np.polynomial.Polynomial([0.3, -2.0, 50.0, 3000.0])
    ends_s = np.array([0.0, steps * step_s])
    ends = np.column_stack([cubic(ends_s), cubic.deriv()(ends_s)]).ravel()
    times_s = np.arange(1, steps + 1) * step_s
    assert weights @ ends == pytest.approx(cubic(times_s), rel=1e-12)


def test_what_the_cubic_leaves_out_is_a_thousandth_of_what_is_measured(air, dynamics):
    # Halfway, given both ends: by conditioning the exact joint distribution of three nodes.
    half, half_covariance = discretize(*dynamics, air_path.NODE_S / 2)
    first = stationary_covariance(air)
    middle = half @ first @ half.T + half_covariance
    cross = np.hstack([half @ first, middle @ half.T])
    ends = np.block(
        [
            [first, (half @ half @ first).T],
            [half @ half @ first, half @ middle @ half.T + half_covariance],
        ]
    )
    left = middle - cross @ np.linalg.solve(ends, cross.T)
    assert air_path.bridge_rms_px(air) == pytest.approx(math.sqrt(left[0, 0]), rel=0.02)
    assert air_path.bridge_rms_px(air) < 0.013 / 500


@pytest.mark.parametrize("motion", [compiled(air_path.air_motion), air_path.air_motion])
@given(seed=st.integers(0, 2**31), steps=st.integers(1, 20), nodes=st.integers(1, 30))
def test_the_motion_is_the_reference_motion(air, motion, seed, steps, nodes):
    random = np.random.default_rng(seed)
    normals, state = random.standard_normal((nodes, 2, 2)), random.standard_normal((2, 2))
    matrices = (*step_matrices(air, steps * 5e-4), air_path.bridge_weights(steps, 5e-4))
    found_state, found_px = state.copy(), np.empty((nodes * steps, 2))
    motion(found_state, normals, *matrices, found_px)
    reference_px = plant_references.air_motion(state, normals, *matrices)
    assert found_px == pytest.approx(reference_px, rel=1e-9, abs=1e-12)
    assert found_state == pytest.approx(state, rel=1e-9, abs=1e-12)


# ---------------------------------------------------------------- the plant's own motion


@pytest.fixture(scope="module")
def motion_px(rig):
    """Pointing spot of resting stages at 50 Hz: shape (samples, runs and axes)."""
    plant = Plant(rig, range(8), star_offset_px=np.zeros((8, 2))).stellar_loops["right"]
    target = rig.loops["right"].target_px
    times_s = np.arange(1, 100 * 50 + 1) / 50
    spots = np.array([plant.spots_px(time_s)[:, 0] for time_s in times_s])
    return (spots - [target.az, target.el]).reshape(times_s.size, -1)


@pytest.mark.long
def test_the_plant_moves_by_the_variance_of_eq_9(air, motion_px):
    # A variance over T of a Gaussian signal with autocorrelation r scatters by sqrt(2 int r^2 / T).
    lags_s = np.linspace(-20, 20, 4001)
    a, _, _ = state_space(air)
    covariance = stationary_covariance(air)
    correlation = [(expm(a * abs(lag)) @ covariance)[0, 0] / covariance[0, 0] for lag in lags_s]
    total_s = motion_px.size / 50
    scatter = math.sqrt(2 * np.trapezoid(np.square(correlation), lags_s) / total_s)
    assert np.var(motion_px) / covariance[0, 0] == pytest.approx(1.0, abs=4 * scatter)


def test_the_plants_spectrum_is_that_of_eq_9(air, motion_px):
    frequency_hz, measured = welch(motion_px, fs=50, nperseg=1000, axis=0)
    ratio = measured.mean(axis=1) / psd_px2_per_hz(air, np.maximum(frequency_hz, 1e-9))
    segments = 9 * motion_px.shape[1] / 1.5  # half-overlapped Hann segments are not independent
    for low_hz, high_hz in [(0.1, 0.3), (0.3, 1.0), (1.0, 3.0), (3.0, 8.0)]:
        band = (frequency_hz >= low_hz) & (frequency_hz < high_hz)
        independent = segments * max(1.0, band.sum() / 1.5)  # so are neighbouring bins
        # The window's leakage and aliasing at 50 Hz stay below 3 %.
        assert ratio[band].mean() == pytest.approx(1.0, abs=4 / math.sqrt(independent) + 0.03)


def test_axes_and_runs_move_independently(motion_px):
    correlation = np.corrcoef(motion_px.T)
    off_diagonal = correlation[~np.eye(len(correlation), dtype=bool)]
    assert np.abs(off_diagonal).max() < 0.5  # about 4 sigma for 100 s of a 1.5 s correlation
    assert np.abs(off_diagonal.mean()) < 0.1


@pytest.mark.long
def test_the_fringe_spot_follows_the_pointing_spot_up_to_its_relative_motion(rig, air):
    plant = Plant(rig, range(64)).stellar_loops["right"]
    spots = np.concatenate([plant.spots_px(time_s) for time_s in np.arange(1, 11) * 3.0])
    spot = rig.plant.loops["right"].spots[1]
    apart = spots[:, 1] - spots[:, 0] - [spot.offset_px.az, spot.offset_px.el]
    # 64 runs x 2 axes x 10 looks, each 3 s apart: near enough independent.
    assert np.std(apart) == pytest.approx(air.relative_rms_px, rel=4 / math.sqrt(2 * 600))
