import numpy as np
import pytest
from plant_records import record_of

from fitctl.identify.whitening import whitener
from fitctl.model.image.light import centroid_noise_px


def correlation(values, lag):
    return np.corrcoef(values[:-lag], values[lag:])[0, 1]


@pytest.mark.long
def test_what_air_and_pixels_do_to_a_star_becomes_white_noise_of_unit_variance(rig):
    record = record_of(rig, "right", [], seed=3, extra_s=60.0)
    seen_px = record.star_px
    assert correlation(seen_px[:, 0], 5) > 0.9

    white = whitener(rig, "right", record.tick["mid_exposure_s"])(seen_px)[1:]

    assert np.std(white) == pytest.approx(1.0, rel=0.05)
    assert abs(correlation(white[:, 0], 1)) < 0.06
    assert abs(correlation(white[:, 1], 5)) < 0.06


@pytest.mark.long
def test_lost_frames_make_it_no_less_white(rig):
    record = record_of(rig, "right", [], seed=4, extra_s=60.0)
    kept = np.random.default_rng(0).uniform(size=len(record.star_px)) > 0.3
    white = whitener(rig, "right", record.tick["mid_exposure_s"][kept])(record.star_px[kept])[1:]
    assert np.std(white) == pytest.approx(1.0, rel=0.06)
    assert abs(correlation(white[:, 0], 1)) < 0.06


@pytest.mark.long
@pytest.mark.parametrize("gap_s", [2.0, 10.0, 60.0])
def test_a_gap_of_any_length_makes_it_no_less_white(rig, gap_s):
    record = record_of(rig, "right", [], seed=3, extra_s=70.0)
    times_s = record.tick["mid_exposure_s"]
    kept = (times_s < times_s[0] + 5.0) | (times_s > times_s[0] + 5.0 + gap_s)
    white = whitener(rig, "right", times_s[kept])(record.star_px[kept])[1:]
    assert np.std(white) == pytest.approx(1.0, rel=0.1)


def test_where_the_star_stands_does_not_matter(rig):
    times_s = np.arange(200) * rig.camera.period_s
    noise_px = centroid_noise_px(rig.camera, rig.loops["right"].star_flux_dn, 7)
    constant = whitener(rig, "right", times_s)(np.full((200, 1), 20.0 * noise_px))
    assert np.abs(constant[1:]).max() < 0.01
