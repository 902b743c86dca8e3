"""The visibility that a tilt between two wavefronts leaves."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j1

from fitctl.config import ARCSEC_PER_RAD
from fitctl.controllers.visibility import airy_amplitude, mean_visibility, visibility

APERTURE_M, WAVELENGTH_M = 0.15, 700e-9
ANGLES = st.floats(-1e-4, 1e-4)


@given(x=st.floats(1e-3, 300.0))
def test_it_is_what_scipy_gives(x):
    assert airy_amplitude(x) == pytest.approx(2 * j1(x) / x, abs=1e-8)


@pytest.mark.parametrize("x", [11.999999, 12.0, 12.000001])
def test_series_and_expansion_meet(x):
    assert airy_amplitude(x) == pytest.approx(2 * j1(x) / x, abs=1e-8)


def test_parallel_wavefronts_leave_all_of_it():
    assert visibility(0.0, APERTURE_M, WAVELENGTH_M) == 1.0


@given(tilt_rad=ANGLES)
def test_it_lies_between_0_and_1_and_does_not_depend_on_the_sign(tilt_rad):
    left = visibility(tilt_rad, APERTURE_M, WAVELENGTH_M)
    assert 0.0 <= left <= 1.0 + 1e-12
    assert left == visibility(-tilt_rad, APERTURE_M, WAVELENGTH_M)


def test_the_first_fringes_vanish_at_1_22_wavelengths_over_the_aperture():
    assert visibility(1.21967 * WAVELENGTH_M / APERTURE_M, APERTURE_M, WAVELENGTH_M) < 1e-4


def test_a_quarter_of_an_arcsecond_leaves_0_92():
    tilt_rad = 0.25 / ARCSEC_PER_RAD
    assert visibility(tilt_rad, APERTURE_M, WAVELENGTH_M) == pytest.approx(0.92, abs=0.005)


def test_both_sides_moving_by_a_quarter_of_an_arcsecond_leave_0_73_in_the_mean():
    rms_rad = np.full(2, math.sqrt(2) * 0.25 / ARCSEC_PER_RAD)
    mean = mean_visibility([0.0, 0.0], rms_rad, APERTURE_M, WAVELENGTH_M)
    assert mean == pytest.approx(0.73, abs=0.01)


def test_the_mean_is_that_of_many_draws():
    random = np.random.default_rng(3)
    mean_rad, rms_rad = np.array([1e-6, -5e-7]), np.array([8e-7, 4e-7])
    drawn = mean_rad + rms_rad * random.standard_normal((20_000, 2))
    of_draws = np.mean(
        [visibility(tilt, APERTURE_M, WAVELENGTH_M) for tilt in np.hypot(*drawn.T).tolist()]
    )
    assert mean_visibility(mean_rad, rms_rad, APERTURE_M, WAVELENGTH_M) == pytest.approx(
        of_draws, abs=0.005
    )


def test_a_tilt_that_does_not_move_has_its_own_visibility():
    mean = mean_visibility([1e-6, 0.0], [0.0, 0.0], APERTURE_M, WAVELENGTH_M)
    assert mean == pytest.approx(visibility(1e-6, APERTURE_M, WAVELENGTH_M))
