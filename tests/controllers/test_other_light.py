"""A star beside another loop's spot is measured where it is."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import Spot, default_rig_path, load_rig
from fitctl.config.base import AxisPair
from fitctl.controllers.centroid import (
    _STEPS_PER_PX,
    OtherLight,
    StarSensor,
    _NearLight,
    moving_with_star,
    spot_light,
)
from fitctl.model.image.scene import Scene

STAR = (28.2, 19.9)


@pytest.fixture
def sensor(rig):
    return StarSensor(rig.camera, rig.loops["right"])


def frame(rig, other_px, flux_dn, star_px=STAR, number=1):
    spots = [
        Spot(name=name, offset_px=AxisPair(az=0.0, el=0.0), flux_dn=dn, diameter_px=3.0)
        for name, dn in (("star", 28_000.0), ("other", flux_dn))
    ]
    return Scene(rig.camera, spots).frame(np.array([star_px, other_px]), 1, number)


@pytest.mark.parametrize(
    ("other_px", "flux_dn"),
    [((29.7, 19.0), 4_000.0), ((25.0, 20.0), 4_000.0), ((24.3, 20.3), 4_000.0),
     ((28.0, 15.5), 28_000.0), ((24.0, 16.0), 28_000.0)],
)  # fmt: skip
def test_the_light_of_another_loops_spot_does_not_pull_a_star(rig, sensor, other_px, flux_dn):
    image = frame(rig, other_px, flux_dn)
    pulled = sensor.measure(image, *STAR)
    assert pulled is None or np.abs(pulled.position_px - STAR).max() > 0.1

    sensor.other_light = [OtherLight(*other_px, flux_dn, 3.0)]
    star = sensor.measure(image, *STAR)

    # Six times the noise.
    assert star.position_px == pytest.approx(STAR, abs=0.06)
    assert star.flux_dn == pytest.approx(28_000, abs=6 * 7 * 20)


@pytest.mark.parametrize(
    ("offset_px", "part"), [((3.3, 0.0), 0.4), ((0.5, 3.2), 0.2), ((-3.3, 2.0), 0.5)]
)
def test_a_loops_own_spot_next_to_its_star_does_not_pull_a_fit(offset_px, part):
    (az, el), dn = offset_px, part * 28_000.0
    own = f"{{name='ghost',offset_px={{az={az},el={el}}},flux_dn={dn}}}"
    fitted = load_rig(
        default_rig_path(), ["loops.right.sensor=fit", f"loops.right.other_spots=[{own}]"]
    )
    sensor = StarSensor(fitted.camera, fitted.loops["right"])
    stars = np.random.default_rng(1).uniform(19.6, 20.4, (200, 2))
    images = [frame(fitted, star + offset_px, dn, star, n) for n, star in enumerate(stars)]
    expected = stars + np.random.default_rng(2).normal(0.0, 0.05, stars.shape)
    found = [sensor.measure(image, *place) for image, place in zip(images, expected, strict=True)]
    errors = np.array([one.position_px for one in found]) - stars

    # Without such a spot it is 0.0024 px.
    assert np.sqrt(np.mean(errors**2)) < 1.4 * 0.0024


def test_a_star_beside_its_own_spot_is_fitted_as_well_where_it_was_not_expected():
    own = "{name='ghost',offset_px={az=3.2,el=0.0},flux_dn=8000.0}"
    fitted = load_rig(
        default_rig_path(), ["loops.right.sensor=fit", f"loops.right.other_spots=[{own}]"]
    )
    sensor = StarSensor(fitted.camera, fitted.loops["right"])
    star_px = np.array([20.1, 19.8])
    images = [frame(fitted, star_px + np.array([3.2, 0.0]), 8000.0, star_px, n) for n in range(200)]
    found = [
        sensor.measure(image, *(star_px + np.array([0.5, -0.5]))).position_px for image in images
    ]

    assert np.mean(found, axis=0) == pytest.approx(star_px, abs=0.002)


@given(st.tuples(*[st.floats(-40.0, 40.0)] * 2), st.floats(0.5, 6.0))
@pytest.mark.long
def test_light_of_near_spots_is_that_of_any_spot(star_px, diameter_px):
    loop = load_rig(default_rig_path()).loops["right"]
    loop = loop.model_copy(update={"spot_diameter_px": diameter_px})
    found = _NearLight(loop, loop.other_spots).of_star(*star_px)
    (spot,) = moving_with_star(loop, loop.other_spots, *star_px, 1.0)

    # A place that is wrong by half a step of the table, on both axes.
    steepest = 4 / (math.sqrt(2 * math.pi) * diameter_px)
    assert np.abs(found - spot_light(spot, 0, 0)).max() < spot.flux_dn * steepest / _STEPS_PER_PX


@pytest.mark.parametrize("other_px", [(25.0, 20.0), (24.3, 20.3)])
def test_nor_does_it_pull_a_star_that_is_fitted(rig, other_px):
    fitted = load_rig(default_rig_path(), ["loops.right.sensor=fit"])
    sensor = StarSensor(fitted.camera, fitted.loops["right"])
    sensor.other_light = [OtherLight(*other_px, 4_000.0, 3.0)]
    star = sensor.measure(frame(rig, other_px, 4_000.0), *STAR)

    assert star.position_px == pytest.approx(STAR, abs=6 * 0.0024)


def test_a_spot_that_is_not_near_changes_nothing(rig, sensor):
    image = frame(rig, (20.0, 20.0), 4_000.0)
    alone = sensor.measure(image, *STAR)
    sensor.other_light = [OtherLight(20.0, 20.0, 4_000.0, 3.0)]
    assert sensor.measure(image, *STAR) == alone
