import numpy as np
import pytest
from plant_records import record_of

from fitctl.config import default_rig_path, load_rig
from fitctl.identify.errors import IdentifyError
from fitctl.identify.whitening import LEAST_NOISE_PX, whitener
from fitctl.model.image.light import centroid_noise_px


def correlation(values, lag):
    return np.corrcoef(values[:-lag], values[lag:])[0, 1]


PHOTONS, FIT = "camera.electrons_per_dn=1.0", "loops.right.sensor=fit"


@pytest.mark.long
@pytest.mark.parametrize("changed", [(), (PHOTONS,), (FIT,), (PHOTONS, FIT)])
def test_what_air_and_sensor_do_to_a_star_becomes_white_noise_of_unit_variance(changed):
    rig = load_rig(default_rig_path(), [*changed])
    record = record_of(rig, "right", [], seed=3, extra_s=60.0)
    seen_px = record.star_px
    assert correlation(seen_px[:, 0], 5) > 0.9

    white = whitener(rig, "right", record.tick["mid_exposure_s"], least_noise_px=0.0)(seen_px)[1:]

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


@pytest.mark.timeout(20)
def test_hours_between_two_frames_cost_no_time(rig):
    period_s = rig.camera.period_s
    times_s = np.arange(600) * period_s + np.repeat([0.0, 80_000.0], 300)
    white = whitener(rig, "right", times_s)(np.ones((600, 1)))
    assert np.isfinite(white).all()


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "change",
    [
        lambda times_s: np.append(times_s, 1e12),
        lambda times_s: np.append(times_s, 1e300),
        lambda times_s: np.append(times_s, times_s[-1] - 1.0),
        lambda times_s: times_s / 1e6,
        lambda times_s: np.append(times_s, np.nan),
    ],
)
def test_times_that_cannot_be_of_one_experiment_are_refused(rig, change):
    times_s = np.arange(200) * rig.camera.period_s
    with pytest.raises(IdentifyError, match="the times of the frames of loop right"):
        whitener(rig, "right", change(times_s))


def test_where_the_star_stands_does_not_matter(rig):
    times_s = np.arange(200) * rig.camera.period_s
    noise_px = centroid_noise_px(rig.camera, rig.loops["right"].star_flux_dn, 7)
    constant = whitener(rig, "right", times_s)(np.full((200, 1), 20.0 * noise_px))
    assert np.abs(constant[1:]).max() < 0.01


def innovation_sd_px(rig, **options):
    """One standard deviation of an innovation once the filter has settled, in px."""
    times_s = np.arange(500) * rig.camera.period_s
    jump = np.zeros((500, 1))
    jump[-1] = 1.0
    return 1.0 / whitener(rig, "right", times_s, **options)(jump)[-1, 0]


def test_photons_add_to_the_noise():
    dark, bright = (load_rig(default_rig_path(), sets) for sets in ([], [PHOTONS]))

    assert 1.0 < innovation_sd_px(bright) / innovation_sd_px(dark) < 1.2


def test_a_fit_is_less_noisy_than_a_centroid_but_not_than_the_models_of_the_stages():
    centroid, fit = (load_rig(default_rig_path(), sets) for sets in ([], [FIT]))
    of_models = innovation_sd_px(fit)

    assert of_models == innovation_sd_px(fit, least_noise_px=LEAST_NOISE_PX)
    assert innovation_sd_px(fit, least_noise_px=0.0) < 0.8 * of_models
    assert of_models < 0.8 * innovation_sd_px(centroid)
