"""The photodiodes' scale and the link's delay from a scan of the beam: against the truth, over seeds."""

import functools
import resource

import numpy as np
import pytest

from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.identify.backlash import behind_play
from fitctl.identify.errors import IdentifyError
from fitctl.identify.link import beam
from fitctl.model import air_path
from fitctl.model.metrology.photodiodes import diode_volts
from fitctl.sequences.behaviours.scans import beam_course
from fitctl.sequences.steps import BeamScan

RIG = load_rig(default_rig_path().parent / "fit-testbed.toml")
LOOP = RIG.metrology_loops["metrology"]
TRUE_SENSOR = RIG.plant.loops["metrology"].sensor.model_copy(
    update={"beam_radius_m": 0.0262, "on_axis_v": 4.6, "ambient_v": [0.03, 0.02, 0.01, 0.04]}
)
LATE_S, DELAY_S, PLAY_ARCSEC, AIR_ARCSEC = 0.002, 0.026, 1.1, 0.1
PERIOD_S = 0.04
SEEDS = range(12)


def air_arcsec(random, count):
    """The link's air, shape (samples, 2)."""
    air = RIG.stellar_loops["left"].vernier.air_path
    transition, gain = air_path.step_matrices(air, PERIOD_S)
    state = (
        random.standard_normal((2, 2)) @ np.linalg.cholesky(air_path.stationary_covariance(air)).T
    )
    moved = []
    for _ in range(count):
        moved.append(state[:, 0])
        state = state @ transition.T + random.standard_normal((2, 2)) @ gain.T
    return np.array(moved) * AIR_ARCSEC / air_path.rms_px(air)


def scan(seed, **sensor):
    """Ticks of a scan, whose samples are truly taken LATE_S after their time stamps."""
    random = np.random.default_rng(seed)
    corners = beam_course(BeamScan(cycles=1))
    corner_s = np.array([time_s for time_s, _ in corners])
    corner_arcsec = np.array([place for _, place in corners])
    sampled_s = np.arange(0.0, corner_s[-1], PERIOD_S)
    fine_s = np.sort(np.concatenate([sampled_s, sampled_s + LATE_S, sampled_s + DELAY_S]))

    def course(times_s):
        return np.stack(
            [np.interp(times_s, corner_s, corner_arcsec[:, k]) for k in range(2)], axis=-1
        )

    start = random.uniform(-0.5, 0.5, 2) * PLAY_ARCSEC
    shown = np.stack(
        [
            behind_play(np.append(start[k], course(fine_s)[:, k]), PLAY_ARCSEC / 2)[1:]
            for k in range(2)
        ],
        axis=-1,
    )[np.searchsorted(fine_s, sampled_s + LATE_S)]
    place_m = (
        shown + air_arcsec(random, len(shown))
    ) / ARCSEC_PER_RAD * LOOP.sensor.link_length_m + random.uniform(-2e-4, 2e-4, 2)
    truth = TRUE_SENSOR.model_copy(update=sensor)
    volts = diode_volts(truth, place_m)
    volts += truth.noise_v * random.standard_normal(volts.shape)
    arcsec_per_rad = LOOP.siderostat.sky_arcsec_per_motor_rad
    count_rad = 2 * np.pi / LOOP.siderostat.encoder_counts_per_rev

    def encoders(times_s):
        return np.floor((course(times_s) / arcsec_per_rad + 1.234) / count_rad) * count_rad

    at_sample, at_tick = encoders(sampled_s), encoders(sampled_s + DELAY_S)
    columns = {
        "sampled_s": 50.0 + sampled_s,
        "time_s": 50.0
        + sampled_s
        + DELAY_S
        + LATE_S
        + 1e-4 * random.standard_normal(len(sampled_s)),
        "encoder_read_s": 50.0 + sampled_s + DELAY_S,
        "mode": np.full(len(sampled_s), "STANDBY"),
    }
    for name, pair in (("siderostat", at_sample), ("encoder", at_tick)):
        columns |= {f"{name}_az_rad": pair[:, 0], f"{name}_el_rad": pair[:, 1]}
    sides = ("az_plus", "az_minus", "el_plus", "el_minus")
    return columns | {f"diode_{side}_v": volts[:, number] for number, side in enumerate(sides)}


@functools.cache
def results():
    return [beam.analyse(RIG, "metrology", scan(seed), beam.PhotodiodesResult) for seed in SEEDS]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "truth"),
    [("beam_radius_mm", 26.2), ("on_axis_v", 4.6)],
)
def test_the_interval_holds_the_truth_as_often_as_it_says(name, truth):
    errors = [(getattr(one.found, name) - truth) / getattr(one.sd, name) for one in results()]
    assert np.mean(np.abs(errors) < 1.96) >= 0.8
    assert 0.5 < np.std(errors) < 1.6


@pytest.mark.long
def test_samples_that_are_late_are_found_at_two_speeds_behind_a_play():
    errors = [(one.found.late_ms - 1e3 * LATE_S) / one.sd.late_ms for one in results()]
    # The floor that the encoder's counts set makes this interval a careful one.
    assert np.max(np.abs(errors)) < 3.0
    assert max(one.sd.late_ms for one in results()) < 0.6
    plays = [(one.found.play_az_arcsec, one.found.play_el_arcsec) for one in results()]
    assert np.mean(plays) == pytest.approx(PLAY_ARCSEC, abs=0.1)


@pytest.mark.long
def test_the_delay_counts_from_when_a_sample_was_truly_taken():
    found = beam.analyse(RIG, "metrology", scan(1), beam.LinkDelayResult)
    assert abs(found.delay_s - DELAY_S) < 3 * found.delay_sd_s
    assert found.delay_sd_s < 6e-4
    assert found.fragment()["loops"]["metrology"]["sensor"]["link_delay_s"] == pytest.approx(
        found.delay_s, abs=1e-5
    )
    assert "link delay" in found.lines()[0]


@pytest.mark.long
def test_the_fragment_has_the_scale():
    sensor = results()[0].fragment()["loops"]["metrology"]["sensor"]
    assert sensor["beam_radius_m"] == pytest.approx(0.0262, abs=2e-5)
    assert sensor["on_axis_v"] == pytest.approx(4.6, abs=0.01)


@pytest.mark.long
def test_a_saturated_photodiode_does_not_count():
    ticks = scan(1, on_axis_v=7.0)
    sides = ("az_plus", "az_minus", "el_plus", "el_minus")
    for side in sides:
        ticks[f"diode_{side}_v"] = np.minimum(ticks[f"diode_{side}_v"], 10.0)
    assert max(ticks[f"diode_{side}_v"].max() for side in sides) == 10.0
    found = beam.analyse(RIG, "metrology", ticks, beam.PhotodiodesResult)
    assert found.found.on_axis_v == pytest.approx(7.0, abs=0.01)


@pytest.mark.long
def test_it_is_plotted(tmp_path):
    results()[0].draw().savefig(tmp_path / "beam.png")
    assert (tmp_path / "beam.png").stat().st_size > 10_000


@pytest.mark.long
def test_what_shows_nothing_is_refused():
    with pytest.raises(IdentifyError, match="loop left has no photodiodes"):
        beam.analyse(RIG, "left", scan(1), beam.LinkDelayResult)
    resting = scan(1)
    for name in ("siderostat_el_rad", "encoder_el_rad"):
        resting[name] = np.zeros_like(resting[name])
    with pytest.raises(IdentifyError, match="expected at least half of its radius"):
        beam.analyse(RIG, "metrology", resting, beam.LinkDelayResult)
    few = {name: column[:500] for name, column in scan(1).items()}
    with pytest.raises(IdentifyError, match="500 samples during the scan"):
        beam.analyse(RIG, "metrology", few, beam.LinkDelayResult)
    shaken = scan(1)
    shaken["diode_az_plus_v"] = shaken["diode_az_plus_v"] * (
        1 + 0.02 * np.sin(np.arange(len(shaken["mode"])))
    )
    with pytest.raises(IdentifyError, match="times the noise unexplained"):
        beam.analyse(RIG, "metrology", shaken, beam.PhotodiodesResult)


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "seed", "on_axis_v"),
    [(beam.PhotodiodesResult, 1, 0.0), (beam.LinkDelayResult, 0, 0.01)],
)
def test_photodiodes_with_hardly_any_light_give_nothing(kind, seed, on_axis_v):
    with pytest.raises(IdentifyError, match="the light is too weak to show where the beam is"):
        beam.analyse(RIG, "metrology", scan(seed, on_axis_v=on_axis_v), kind)


@pytest.mark.parametrize("time_s", [1e12, 1e5, 0.0])
def test_a_sample_at_an_impossible_time_is_refused(time_s):
    ticks = scan(1)
    ticks["sampled_s"][-1] = time_s
    with pytest.raises(IdentifyError, match="the times of the samples"):
        beam.analyse(RIG, "metrology", ticks, beam.LinkDelayResult)


@pytest.mark.long
def test_a_pause_of_hours_needs_no_memory_for_each_pair_of_its_moments():
    ticks = scan(1)
    for name in ("time_s", "sampled_s", "encoder_read_s"):
        ticks[name][-20:] += 40_000.0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    beam.analyse(RIG, "metrology", ticks, beam.LinkDelayResult)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20  # KiB


@pytest.mark.long
def test_samples_that_are_no_numbers_do_not_count():
    ticks = scan(1)
    ticks["encoder_az_rad"][40] = np.nan
    ticks["diode_az_plus_v"][50] = 1e300
    found = beam.analyse(RIG, "metrology", ticks, beam.LinkDelayResult)
    assert abs(found.delay_s - DELAY_S) < 3 * found.delay_sd_s
    assert len(found.volts) == len(ticks["mode"]) - 2
