"""The step `camera`: what frames make of the rig file's camera, and what they cannot."""

from types import SimpleNamespace

import numpy as np
import pytest
from commissioning.motor_bench import RIG, site_of

from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import camera as step
from fitctl.drivers.interface import Frame

CAMERA = RIG.camera


class BenchCamera:
    """Dark frames on time, on which `change` puts something; its arguments are the image and the number."""

    def __init__(self, change):
        self._change = change
        self._random = np.random.default_rng(0)
        self._number = 0

    def open(self):
        pass

    start = close = open

    def next_frame(self, _timeout_s):
        self._number += 1
        dark = CAMERA.bias_dn + CAMERA.pixel_noise_dn * self._random.standard_normal(
            (CAMERA.height_px, CAMERA.width_px)
        )
        image = np.rint(dark).astype(np.uint16)
        self._change(image, self._number)
        exposed_s = self._number / CAMERA.frame_rate_hz
        return Frame(
            image=image,
            number=self._number,
            mid_exposure_s=exposed_s,
            received_s=exposed_s + CAMERA.frame_delay_s,
        )

    def counts(self):
        return SimpleNamespace(lost=0, packets_lost=0)


@pytest.fixture
def check(monkeypatch):
    def run(change):
        device = CAMERA.device.driver
        monkeypatch.setitem(step.CAMERAS, device, lambda _settings: BenchCamera(change))
        return step.check_camera(site_of())

    return run


def nothing(_image, _number):
    pass


def hot_pixel(image, _number):
    image[7, 30] = CAMERA.full_scale_dn


def cosmic_ray(image, number):
    if number == 40:
        image[20:22, 15:19] = CAMERA.full_scale_dn


def star(image, _number):
    image[18:22, 18:22] = CAMERA.full_scale_dn


def test_a_camera_that_is_as_the_rig_file_says_passes(check):
    outcome = check(nothing)
    assert outcome.state == "passed"
    assert outcome.figures["noise_dn"] == pytest.approx(CAMERA.pixel_noise_dn, rel=0.05)
    assert outcome.figures["frame_rate_hz"] == pytest.approx(CAMERA.frame_rate_hz)


def test_a_hot_pixel_is_named_and_is_no_star_that_saturates(check):
    outcome = check(hot_pixel)
    assert outcome.state == "passed"
    assert "1 hot pixels at (az, el) (30, 7)" in outcome.lines[-1]


def test_a_cosmic_ray_is_no_star_that_saturates(check):
    assert check(cosmic_ray).state == "passed"


def test_a_star_that_saturates_is_named(check):
    with pytest.raises(StepError, match="the star saturates"):
        check(star)


def test_the_images_of_a_large_camera_fit_into_the_memory_of_a_small_computer(check, monkeypatch):
    large = CAMERA.model_copy(update={"width_px": 1920, "height_px": 1200})
    kept = step._kept_images(large)
    assert kept >= 10
    assert 2 * kept * large.width_px * large.height_px <= 128 << 20

    few = 20 * 2 * CAMERA.width_px * CAMERA.height_px
    monkeypatch.setattr(step, "_MOST_IMAGES_BYTES", few)
    outcome = check(nothing)
    assert outcome.figures["noise_dn"] == pytest.approx(CAMERA.pixel_noise_dn, rel=0.1)
    assert outcome.figures["frame_rate_hz"] == pytest.approx(CAMERA.frame_rate_hz)
