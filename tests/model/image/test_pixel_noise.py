"""Pixel noise is white, normal and a function of run, frame and pixel."""

import numpy as np
import pytest
from scipy.stats import kstest

from fitctl.model.image.pixel_noise import noise_key, pixel_normals, quantiles

PIXELS = 40 * 40
FRAMES = 500


@pytest.fixture(scope="module")
def frames():
    key = noise_key(np.random.SeedSequence(1))
    return np.array([pixel_normals(key, number, PIXELS) for number in range(FRAMES)])


def test_it_has_the_moments_of_a_normal(frames):
    count = frames.size
    assert frames.mean() == pytest.approx(0.0, abs=5 / np.sqrt(count))
    assert frames.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / count))
    assert (frames**3).mean() == pytest.approx(0.0, abs=5 * np.sqrt(15 / count))
    assert (frames**4).mean() == pytest.approx(3.0, abs=5 * np.sqrt(96 / count))


def test_it_has_the_distribution_of_a_normal(frames):
    assert kstest(frames[:50].ravel(), "norm").pvalue > 1e-4


@pytest.mark.parametrize("lag", [1, 2, 3, 7, 40, 41, 1600])
def test_pixels_and_frames_are_not_correlated(frames, lag):
    noise = frames.ravel()
    assert np.mean(noise[lag:] * noise[:-lag]) == pytest.approx(0.0, abs=5 / np.sqrt(noise.size))


def test_runs_are_not_correlated():
    runs = [pixel_normals(noise_key(np.random.SeedSequence(seed)), 7, 100_000) for seed in (1, 2)]
    assert np.mean(runs[0] * runs[1]) == pytest.approx(0.0, abs=5 / np.sqrt(100_000))


def test_the_same_frame_has_the_same_noise_however_much_of_it_is_made():
    assert np.array_equal(pixel_normals(5, 9, 49), pixel_normals(5, 9, PIXELS)[:49])


def test_noise_alone_stays_within_4_33_sigma():
    table = quantiles()
    assert -table[0] == pytest.approx(table[-1])
    assert table[-1] < 4.33
    assert table.std() == pytest.approx(1.0)
