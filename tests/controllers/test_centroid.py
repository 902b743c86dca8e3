import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import HALF_WINDOW_PX, AxisPair, Spot, default_rig_path, load_rig
from fitctl.controllers.centroid import StarSensor
from fitctl.model.image.scene import Scene

NOWHERE = (-500.0, -500.0)
EDGES = ("left", "right", "bottom", "top")
window_fits = st.tuples(st.floats(3.0, 36.0), st.floats(3.0, 36.0))


@pytest.fixture(scope="module")
def sensor(rig):
    return StarSensor(rig.camera, rig.loops["right"])


@pytest.fixture(scope="module")
def expose(rig):
    """Frames of the pointing spot, and of the fringe spot where one is asked for."""
    scene = Scene(rig.camera, rig.plant.loops["right"].spots)

    def frame(star, fringe=NOWHERE, seed=0):
        return scene.frame(np.array([star, fringe]), seed, 1)

    return frame


def from_edge(edge, away_px, along_px):
    """A place, so far from an edge of the frame."""
    places = (
        (away_px, along_px),
        (39.0 - away_px, along_px),
        (along_px, away_px),
        (along_px, 39.0 - away_px),
    )
    return places[EDGES.index(edge)]


# ---------------------------------------------------------------- Eq. 7


def test_eq_7_by_hand(rig, sensor):
    image = np.full((40, 40), rig.camera.bias_dn, dtype=np.uint16)
    image[20, 10] += 14_000
    image[20, 11] += 7_000
    image[22, 10] += 7_000
    star = sensor.measure(image, 10, 21)
    assert star.flux_dn == 28_000
    assert star.az_px == pytest.approx(10.25)
    assert star.el_px == pytest.approx(20.5)
    assert (star.window_az_px, star.window_el_px) == (10, 21)


@given(place=window_fits, seed=st.integers(0, 1000))
def test_the_star_is_measured_where_it_is(sensor, expose, place, seed):
    star = sensor.measure(expose(place, seed=seed), *place)
    # Six times the noise.
    assert (star.az_px, star.el_px) == pytest.approx(place, abs=0.06)


@pytest.mark.parametrize("centre", [(-9.0, 12.0), (99.0, 99.0), (20.0, -3.0)])
def test_a_window_asked_for_beyond_the_frame_is_moved_onto_it(sensor, expose, centre):
    image = expose(NOWHERE)
    star = sensor.measure(image, *centre)
    assert star is None
    nearest = np.clip(centre, HALF_WINDOW_PX, 36)
    star = sensor.measure(expose(nearest), *centre)
    assert (star.window_az_px, star.window_el_px) == tuple(nearest)


def test_a_window_beside_the_star_measures_nothing(sensor, expose):
    assert sensor.measure(expose((24.0, 19.5)), 12.0, 19.5) is None


def test_a_spot_of_another_brightness_is_not_this_loops_star(sensor, expose):
    image = expose(NOWHERE, fringe=(12.0, 19.5))
    assert sensor.measure(image, 12.0, 19.5) is None
    assert sensor.find(image) is None


# ---------------------------------------------------------------- the finder


@given(place=window_fits, seed=st.integers(0, 1000))
def test_the_star_is_found_anywhere_that_the_window_fits(sensor, expose, place, seed):
    star = sensor.find(expose(place, seed=seed))
    assert (star.az_px, star.el_px) == pytest.approx(place, abs=0.06)


@given(place=window_fits)
def test_the_star_is_found_beside_its_fringe_spot(sensor, expose, place):
    fringe = (place[0] - 12.0, place[1])
    star = sensor.find(expose(place, fringe=fringe))
    assert (star.az_px, star.el_px) == pytest.approx(place, abs=0.06)


@pytest.mark.parametrize("hot_dn", [300, 8_000, 16_800, 28_000, 44_800, 64_000])
@pytest.mark.parametrize("with_star", [True, False])
def test_a_hot_pixel_is_not_the_star(sensor, expose, hot_dn, with_star):
    image = expose((24.0, 19.5) if with_star else NOWHERE)
    image[30, 8] += hot_dn
    star = sensor.find(image)
    if with_star:
        assert (star.az_px, star.el_px) == pytest.approx((24.0, 19.5), abs=0.06)
    else:
        assert star is None


def test_many_hot_pixels_do_not_hide_a_dim_star(sensor, expose):
    image = expose((24.0, 19.5))
    for az_px in (3, 10, 17, 31, 37):
        image[[3, 10, 29, 36], az_px] += 30_000
    star = sensor.find(image)
    assert (star.az_px, star.el_px) == pytest.approx((24.0, 19.5), abs=0.06)


@pytest.mark.parametrize("hot_dn", [300, 8_000, 16_800, 28_000, 44_800, 64_000])
def test_a_hot_pixel_in_the_window_is_not_held_for_the_star_that_has_gone(sensor, expose, hot_dn):
    image = expose(NOWHERE)
    image[20, 25] += hot_dn
    assert sensor.measure(image, 24.0, 19.5) is None


@pytest.mark.parametrize("hot_dn", [17_000, 28_000, 44_800, 64_000])
def test_a_hot_pixel_beside_the_star_is_no_measurement(sensor, expose, hot_dn):
    image = expose((24.0, 19.5))
    image[20, 26] += hot_dn
    assert sensor.measure(image, 24.0, 19.5) is None


def test_noise_alone_is_never_a_star(sensor, expose):
    assert not any(sensor.find(expose(NOWHERE, seed=seed)) for seed in range(300))


@given(
    beyond=st.floats(-2.0, 1.5),
    along=st.floats(0.0, 39.0),
    edge=st.sampled_from(EDGES),
)
def test_a_spot_cut_by_the_frames_edge_is_not_accepted(sensor, expose, beyond, along, edge):
    place = from_edge(edge, beyond, along)
    assert sensor.find(expose(place)) is None


# ---------------------------------------------------------------- the fit on whole frames


def fitted(*settings):
    rig = load_rig(default_rig_path(), ["loops.right.sensor=fit", *settings])
    return rig, StarSensor(rig.camera, rig.loops["right"])


@given(
    away=st.floats(2.0, 3.0),
    along=st.floats(2.0, 37.0),
    edge=st.sampled_from(EDGES),
)
@pytest.mark.long
def test_near_an_edge_of_the_frame_the_fit_is_as_good(expose, away, along, edge):
    _, sensor = fitted()
    place = from_edge(edge, away, along)
    star = sensor.in_window(expose(place), *place)
    assert (star.az_px, star.el_px) == pytest.approx(place, abs=6 * 0.0024)


@pytest.mark.parametrize(("pixel_format", "full_dn"), [("Mono12", 4095), ("Mono16", 65535)])
def test_a_saturated_pixel_is_no_measurement_of_the_fit(pixel_format, full_dn):
    """Of a star that is brighter than its rig file has it; the noise is small, so that it shows."""
    rig, sensor = fitted(
        f"camera.device.pixel_format={pixel_format}",
        "camera.pixel_noise_dn=2.0",
        f"loops.right.star_flux_dn={3.9 * (full_dn - 1000)}",
        "loops.right.other_spots=[]",
        "loops.right.flux_range={low=0.75,high=1.4}",
    )
    spot = Spot(
        name="star",
        offset_px=AxisPair(az=0.0, el=0.0),
        flux_dn=4.3 * (full_dn - 1000),
        diameter_px=3.0,
    )
    scene, errors_px = Scene(rig.camera, [spot]), []
    for number, place in enumerate(np.random.default_rng(1).uniform(19.8, 20.2, (40, 2))):
        image = scene.frame(np.array([place]), 1, number)
        assert image.max() == full_dn
        errors_px.append(sensor.in_window(image, *place).position_px - place)
    assert np.std(errors_px) < 1e-3
