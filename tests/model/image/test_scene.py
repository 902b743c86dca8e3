import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.controllers.centroid import StarSensor
from fitctl.model.compiled import numba_installed
from fitctl.model.image.light import centroid_noise_px
from fitctl.model.image.scene import Scene

within = st.floats(6.0, 33.0)  # a spot's light is all on the frame


@pytest.fixture(scope="module")
def spots(rig):
    return rig.plant.loops["right"].spots


@pytest.fixture(scope="module")
def star_only(rig, spots):
    return Scene(rig.camera, spots[:1])


def light(rig, frame):
    return np.asarray(frame) - rig.camera.bias_dn


@given(az_px=within, el_px=within)
def test_all_of_a_spots_light_is_on_the_frame(rig, spots, star_only, az_px, el_px):
    image = light(rig, star_only.expected(np.array([[az_px, el_px]])))
    assert image.shape == (rig.camera.height_px, rig.camera.width_px)
    assert image.sum() == pytest.approx(spots[0].flux_dn, rel=1e-6)


@given(az_px=within, el_px=within)
def test_a_spots_centre_of_gravity_is_where_it_was_put(rig, star_only, az_px, el_px):
    image = light(rig, star_only.expected(np.array([[az_px, el_px]])))
    rows, columns = np.indices(image.shape)
    assert (image * columns).sum() / image.sum() == pytest.approx(az_px, abs=1e-4)
    assert (image * rows).sum() / image.sum() == pytest.approx(el_px, abs=1e-4)


def test_half_the_light_of_a_spot_on_the_frames_edge_is_lost(rig, spots, star_only):
    image = light(rig, star_only.expected(np.array([[-0.5, 20.0]])))
    assert image.sum() == pytest.approx(spots[0].flux_dn / 2, rel=1e-6)


def test_a_spots_diameter_is_four_standard_deviations(rig, spots, star_only):
    image = light(rig, star_only.expected(np.array([[19.5, 19.5]])))
    sigma_px = spots[0].diameter_px / 4
    for half in (1, 2, 3):  # columns within so many pixels of the spot
        part = image[:, 20 - half : 20 + half].sum() / image.sum()
        assert part == pytest.approx(math.erf(half / sigma_px / math.sqrt(2)), abs=1e-6)


def test_spots_add_up(rig, spots, star_only):
    places = np.array([[24.0, 19.5], [12.0, 19.5]])
    both = light(rig, Scene(rig.camera, spots).expected(places))
    fringe = light(rig, Scene(rig.camera, spots[1:]).expected(places[1:]))
    assert both == pytest.approx(light(rig, star_only.expected(places[:1])) + fringe, abs=1e-9)


def test_a_batch_of_frames_is_each_frame_alone(rig, spots):
    scene = Scene(rig.camera, spots)
    places = np.random.default_rng(0).uniform(5, 35, (3, 2, 2))
    batch = scene.expected(places)
    assert batch.shape == (3, rig.camera.height_px, rig.camera.width_px)
    assert batch[1] == pytest.approx(scene.expected(places[1]))


def test_pixels_have_the_rigs_noise_about_its_bias(rig, star_only):
    nowhere = np.array([[-500.0, -500.0]])
    dark = np.array([star_only.frame(nowhere, 1, number) for number in range(50)], dtype=float)
    assert dark.mean() == pytest.approx(rig.camera.bias_dn, abs=5 * 20 / np.sqrt(dark.size))
    assert dark.std() == pytest.approx(rig.camera.pixel_noise_dn, rel=5 / np.sqrt(2 * dark.size))


def test_a_glaring_star_saturates_and_does_not_wrap(rig, spots):
    glare = spots[0].model_copy(update={"flux_dn": 1e7})
    image = Scene(rig.camera, [glare]).frame(np.array([[20.0, 20.0]]), 0, 0)
    assert image.dtype == np.uint16
    assert image[20, 20] == rig.camera.full_scale_dn
    assert np.all(image[18:23, 20] > 10_000)


def test_noise_below_zero_reads_zero(rig, spots):
    dark = rig.camera.model_copy(update={"bias_dn": 0.0})
    image = Scene(dark, spots[:1]).frame(np.array([[-500.0, 0.0]]), 0, 0)
    assert image.min() == 0
    assert image.max() < 200


def test_centroid_noise_by_formula_is_0_01_px(rig):
    assert centroid_noise_px(rig.camera, 28_000.0, 7) == pytest.approx(0.01)


def test_centroid_noise_over_rendered_frames_is_what_the_formula_says(rig, star_only):
    random = np.random.default_rng(2)
    sensor = StarSensor(rig.camera, rig.loops["right"])
    frames = 1500
    # Anywhere within a pixel, as in the loop.
    places = np.array([24.0, 19.5]) + random.uniform(-0.5, 0.5, (frames, 2))
    stars = [
        sensor.measure(star_only.frame(place[None], 2, number), *place)
        for number, place in enumerate(places)
    ]
    errors_px = np.array([[star.az_px, star.el_px] for star in stars]) - places
    expected_px = centroid_noise_px(rig.camera, 28_000.0, 7)
    assert errors_px.std() == pytest.approx(expected_px, rel=4 / np.sqrt(2 * errors_px.size) + 0.02)
    assert np.abs(errors_px.mean()) < 4 * expected_px / np.sqrt(errors_px.size) + 1e-4


@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
@given(
    places=st.lists(st.tuples(st.floats(-20, 60), st.floats(-20, 60)), min_size=2, max_size=2),
    key=st.integers(0, 2**64 - 1),
    number=st.integers(0, 10**7),
)
def test_the_compiled_frame_is_the_reference_frame(rig, spots, places, key, number):
    scene = Scene(rig.camera, spots)
    compiled = scene.frame(np.array(places), key, number)
    reference = scene.frame_reference(np.array(places), key, number)
    # Where a sum comes to half a DN, the last bit may round it either way.
    assert np.count_nonzero(compiled != reference) <= 1
    assert np.abs(compiled.astype(int) - reference).max() <= 1
