"""Frames are light of a whole exposure: what moves meanwhile is smeared."""

import math

import numpy as np
import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.model.image.scene import Scene
from fitctl.model.plant import Plant
from fitctl.simulation.devices import SimulatedCamera
from fitctl.simulation.simulation import Simulation

STILL_AIR = "plant.loops.right.air_path.gain_px=0.0"
NO_NOISE = "camera.pixel_noise_dn=0.001"


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def plant_of(rig):
    return Plant(rig, [1], star_offset_px=np.zeros((1, 2)))


def vibrating(frequency_hz, rms_px):
    return (
        f"plant.loops.right.lines=[{{frequency_hz={frequency_hz}, rms_px={rms_px}, direction_deg=0.0, "
        "damping=0.0, drift_hz_per_min=0.0}]"
    )


def scene_of(rig):
    truth, _ = rig.mock_parts()
    return Scene(rig.camera, truth.loops["right"].spots, instants=truth.exposure_instants)


def place_and_width_px(rig, image):
    """Mean and standard deviation of the pointing spot's light along azimuth."""
    dn = (image - rig.camera.bias_dn)[:, 19:].sum(axis=0)
    columns = np.arange(19, 19 + dn.size)
    mean_px = (dn * columns).sum() / dn.sum()
    return mean_px, math.sqrt((dn * (columns - mean_px) ** 2).sum() / dn.sum())


def test_a_frame_is_the_mean_of_its_instants():
    rig = rig_with("plant.exposure_instants=4")
    plant, instant = plant_of(rig), Scene(rig.camera, rig.plant.loops["right"].spots)

    image = scene_of(rig).expected(plant.exposure_px(0.5)[0])

    # Midway in four parts of 10 ms, on the plant's grid of 0.5 ms
    at_s = 0.5 + np.array([-4e-3, -1e-3, 1e-3, 4e-3])
    images = [instant.expected(plant.spots_px(time_s)[0]) for time_s in at_s]
    assert image == pytest.approx(np.mean(images, axis=0), abs=1e-6)


def test_one_instant_is_the_middle_of_the_exposure():
    rig = rig_with()
    plant = plant_of(rig)

    assert np.array_equal(plant.exposure_px(0.5), plant.spots_px(0.5))


def test_a_spot_that_moves_is_wider_and_stands_where_it_was_on_average():
    # The siderostat turns the star by 200 px/s: 2 px in an exposure.
    rig = rig_with(
        STILL_AIR, "plant.exposure_instants=8", "plant.loops.right.backlash_sky_arcsec=0.0"
    )
    plant = plant_of(rig)
    star = plant.stellar_loops["right"]
    star.inputs.velocity_rad_s[0, 0] = 200.0 / star.constants.motor_px_per_rad
    plant.advance(0.02)  # the amplifier follows
    star.inputs.velocity_rad_s[0, 0] *= -1
    plant.advance(0.045)

    scene, at_s = scene_of(rig), 0.035
    plant.advance(at_s + rig.camera.exposure_s)
    image = scene.expected(plant.exposure_px(at_s)[0])

    mean_px, width_px = place_and_width_px(rig, image)
    assert mean_px == pytest.approx(plant.spots_px(at_s)[0, 0, 0], abs=0.01)
    still_px2 = (3.0 / 4) ** 2 + 1 / 12  # the spot's own width, and a pixel's
    smear_px2 = 2.0**2 / 12
    assert width_px == pytest.approx(math.sqrt(still_px2 + smear_px2), rel=0.01)


@pytest.mark.parametrize(("frequency_hz", "left"), [(10.0, 0.984), (50.0, 0.637), (100.0, 0.0)])
def test_an_exposure_attenuates_a_vibration_by_the_sinc_of_its_length(frequency_hz, left):
    rig = rig_with(STILL_AIR, vibrating(frequency_hz, 0.1), "plant.exposure_instants=16")
    plant, scene = plant_of(rig), scene_of(rig)
    middle_px = plant.stellar_loops["right"].constants.spot_origin_px[0, 0, 0]
    times_s = 0.1 + np.arange(0, 1.0, 0.0035)

    images = [scene.expected(plant.exposure_px(time_s)[0]) for time_s in times_s]

    found_px = np.array([place_and_width_px(rig, image)[0] for image in images]) - middle_px
    assert found_px.std() / 0.1 == pytest.approx(left, abs=0.01)


def test_the_simulated_cameras_frames_are_smeared():
    rig = rig_with(STILL_AIR, NO_NOISE, vibrating(100.0, 0.5), "plant.exposure_instants=8")
    simulation = Simulation(rig, 1, star_offset_px=np.zeros(2))
    camera: SimulatedCamera = simulation.camera
    camera.on_servo_period = [(1.0, lambda: None)]
    camera.start()

    images = [camera.next_frame(1.0).image for _ in range(10)]

    for image in images:
        mean_px, width_px = place_and_width_px(rig, image.astype(float))
        assert mean_px == pytest.approx(rig.loops["right"].target_px.az, abs=0.01)
        assert width_px == pytest.approx(math.sqrt(0.75**2 + 1 / 12 + 0.25), rel=0.02)


def test_a_frame_that_would_be_there_before_its_exposure_ends_is_an_error():
    with pytest.raises(ConfigError, match=r"frame_delay_s must be at least 0\.005"):
        rig_with("plant.exposure_instants=2", "plant.frame_delay_s=0.004")

    assert rig_with("plant.exposure_instants=1", "plant.frame_delay_s=0.004")
