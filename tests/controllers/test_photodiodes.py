"""Where the metrology beam is, by its four photodiodes."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.controllers.photodiodes import (
    MEANING,
    BeamState,
    PhotodiodeArray,
    ambient_of,
    capture_radius_m,
    reach_m,
)
from fitctl.model.metrology.photodiodes import diode_volts

SIGMA = 6.0


class Settings(NamedTuple):
    diode_offset_m: float = 0.012
    beam_radius_m: float = 0.025
    on_axis_v: float = 5.0
    noise_v: float = 0.001
    ambient_v: tuple = (0.02, 0.03, 0.01, 0.025)
    saturated_v: float = 10.0


SENSOR = Settings()
ARRAY = PhotodiodeArray(SENSOR, SIGMA)
# Within it, a beam gives light to all four diodes; the worst direction is away from one.
MEASURED_M = reach_m(SENSOR, SIGMA) - SENSOR.diode_offset_m
CAPTURE_M = capture_radius_m(SENSOR, SIGMA)
DIRECTIONS = st.floats(-math.pi, math.pi)


def polar(radius_m, direction_rad):
    return radius_m * math.cos(direction_rad), radius_m * math.sin(direction_rad)


def read(az_m, el_m, array=ARRAY, sensor=SENSOR):
    return array.beam(tuple(diode_volts(sensor, [az_m, el_m]).tolist()))


@given(radius=st.floats(0.0, 0.999), direction_rad=DIRECTIONS)
def test_the_log_ratio_is_exact_wherever_all_diodes_have_light(radius, direction_rad):
    az_m, el_m = polar(radius * MEASURED_M, direction_rad)
    beam = read(az_m, el_m)
    assert beam.state is BeamState.MEASURED
    assert (beam.az_m, beam.el_m) == pytest.approx((az_m, el_m), abs=1e-9)


@given(part=st.floats(0.0, 0.999), direction_rad=DIRECTIONS)
def test_no_beam_within_the_capture_radius_is_lost(part, direction_rad):
    assert read(*polar(part * CAPTURE_M, direction_rad)).state is not BeamState.LOST


def test_between_two_diodes_a_beam_beyond_the_capture_radius_is_lost():
    assert read(*polar(1.001 * CAPTURE_M, math.pi / 4)).state is BeamState.LOST


def test_away_from_a_diode_a_beam_beyond_the_measured_radius_is_at_the_edge():
    assert read(-1.001 * MEASURED_M, 0.0).state is BeamState.EDGE
    assert read(-0.999 * MEASURED_M, 0.0).state is BeamState.MEASURED


def test_the_radii_are_those_of_this_array():
    assert MEASURED_M / SENSOR.beam_radius_m == pytest.approx(1.42, abs=0.02)
    assert CAPTURE_M / SENSOR.beam_radius_m == pytest.approx(2.2, abs=0.05)


@given(part=st.floats(1.001, 1.6), direction_rad=DIRECTIONS)
def test_at_the_edge_the_estimate_has_the_right_direction_and_is_never_too_far(part, direction_rad):
    az_m, el_m = polar(part * MEASURED_M, direction_rad)
    beam = read(az_m, el_m)
    if beam.state is not BeamState.EDGE:
        return
    for estimate_m, true_m in ((beam.az_m, az_m), (beam.el_m, el_m)):
        assert estimate_m * true_m >= -1e-30
        assert abs(estimate_m) <= abs(true_m) + 1e-12
    assert math.hypot(beam.az_m, beam.el_m) > 0.0


def test_a_step_by_the_estimate_brings_any_captured_beam_nearer_until_it_is_measured():
    for direction_rad in np.linspace(-math.pi, math.pi, 73):
        az_m, el_m = polar(0.99 * CAPTURE_M, direction_rad)
        for _ in range(10):
            beam = read(az_m, el_m)
            if beam.state is BeamState.MEASURED:
                break
            nearer = az_m - beam.az_m, el_m - beam.el_m
            assert math.hypot(*nearer) < math.hypot(az_m, el_m)
            az_m, el_m = nearer
        assert beam.state is BeamState.MEASURED


@pytest.mark.parametrize("place_m", [(0.0, 0.0), (0.01, 0.0), (-0.02, 0.01), (0.03, 0.0)])
def test_the_noise_is_that_of_many_samples(place_m):
    random = np.random.default_rng(1)
    volts = diode_volts(SENSOR, place_m) + SENSOR.noise_v * random.standard_normal((4000, 4))
    beams = [ARRAY.beam(tuple(row)) for row in volts.tolist()]
    stated = read(*place_m)
    for axis, name in enumerate(("az_m", "el_m")):
        spread_m = np.std([getattr(beam, name) for beam in beams])
        assert spread_m == pytest.approx(stated[3 + axis], rel=0.1)


def test_on_axis_the_noise_is_1_8_um():
    assert read(0.0, 0.0).noise_az_m == pytest.approx(1.84e-6, rel=0.01)


def test_ambient_light_that_is_not_subtracted_moves_a_beam_that_is_off_axis():
    blind = PhotodiodeArray(SENSOR._replace(ambient_v=(0.0,) * 4), SIGMA)
    assert abs(read(0.02, 0.0, blind).az_m - 0.02) > 1e-4
    assert read(0.02, 0.0).az_m == pytest.approx(0.02, abs=1e-9)


def test_darkness_is_lost_whatever_the_noise():
    random = np.random.default_rng(2)
    volts = np.array(SENSOR.ambient_v) + SENSOR.noise_v * random.standard_normal((20_000, 4))
    assert {ARRAY.beam(tuple(row)).state for row in volts.tolist()} == {BeamState.LOST}
    assert math.isnan(ARRAY.beam(SENSOR.ambient_v).az_m)


def test_light_that_is_twice_too_strong_saturates_and_still_has_its_direction():
    bright = SENSOR._replace(on_axis_v=12.0)
    beam = read(0.02, 0.0, sensor=bright)
    assert beam.state is BeamState.SATURATED
    assert 0.0 < beam.az_m <= 0.02


def test_twice_the_noise_captures_less():
    assert capture_radius_m(SENSOR._replace(noise_v=0.002), SIGMA) < CAPTURE_M
    assert capture_radius_m(SENSOR._replace(noise_v=10.0), SIGMA) == 0.0


def test_ambient_light_is_the_mean_of_samples_without_the_beam():
    random = np.random.default_rng(5)
    samples_v = np.array(SENSOR.ambient_v) + SENSOR.noise_v * random.standard_normal((500, 4))
    ambient_v, error_v = ambient_of(samples_v)
    assert np.all(np.abs(ambient_v - SENSOR.ambient_v) < 4 * error_v)
    assert error_v == pytest.approx(SENSOR.noise_v / math.sqrt(500), rel=0.2)


def test_every_state_is_explained():
    assert set(MEANING) == set(BeamState)
