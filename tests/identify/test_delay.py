import dataclasses

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig, rig_from_document
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.identify import delay
from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import ExperimentRecord
from fitctl.model.drives import FSM, channel_values, experiment_s
from fitctl.model.optics import scales, stack_volts
from fitctl.model.plant import Plant

pytestmark = pytest.mark.long

HOLD_S = 0.0073  # as the supervisor's injector: no common measure with the frames
STARTED_S = 5000.0
# The plant shows a voltage from the grid step after it on, which is half a step late on average.
SHOWN_LATE_S = 0.00025


def swings(rig, seed=0, stamp_error_s=0.0, delay_s=0.035, exposure_s=0.0, drives=None):
    """An experiment on the plant alone; frames truly exposed `stamp_error_s` after their stamps."""
    loop, period_s = rig.loops["right"], rig.camera.period_s
    fsm, scale = loop.fsm, scales(rig, loop)
    drives = delay.plan(rig, "right") if drives is None else drives
    plant = Plant(rig, [seed], star_offset_px=np.zeros((1, 2))).stellar_loops["right"]
    end_s = experiment_s(drives) + 0.5
    written_s = np.arange(0.0, end_s, HOLD_S)
    volts = np.full((len(written_s) + 1, 3), fsm.bias_v)
    for row, time_s in enumerate(written_s, start=1):
        plant.advance(time_s)
        mirror_rad = channel_values(drives, FSM, time_s) / scale.mirror_px_per_rad
        volts[row] = stack_volts(
            mirror_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v
        )
        plant.inputs.stack_v[0] = volts[row]
    plant.advance(end_s)
    exposed_s = np.arange(0.011, end_s - 0.02, period_s)
    random = np.random.default_rng(seed)
    star_px = np.array(
        [
            plant.history_px(time_s - exposure_s / 2, time_s + exposure_s / 2)[:, 0, 0].mean(axis=0)
            for time_s in exposed_s
        ]
    )
    noise_px = sensor_noise_px(rig.camera, loop, loop.star_flux_dn)
    star_px += noise_px * random.standard_normal(star_px.shape)
    tick = {
        "time_s": STARTED_S + exposed_s + delay_s + random.exponential(0.0005, len(exposed_s)),
        "mid_exposure_s": STARTED_S + exposed_s - stamp_error_s,
        "star_visible": np.ones(len(exposed_s), dtype=bool),
        "star_az_px": star_px[:, 0],
        "star_el_px": star_px[:, 1],
        "star_flux_dn": np.full(len(exposed_s), loop.star_flux_dn),
    }
    return ExperimentRecord("right", tick, STARTED_S + np.append(0.0, written_s), volts)


def with_ticks(record, **changes):
    return dataclasses.replace(record, tick=record.tick | changes)


@pytest.fixture(scope="module")
def record(rig):
    return swings(rig)


@pytest.fixture(scope="module")
def result(record, rig):
    return delay.analyse(rig, record)


def test_right_stamps_are_found_right_to_a_tenth_of_a_millisecond(result):
    assert result.stamp_error_s == pytest.approx(-SHOWN_LATE_S, abs=0.0001)
    assert not result.blurred


@pytest.mark.parametrize("changed", ["camera.electrons_per_dn=1.0", "loops.right.sensor=fit"])
def test_with_another_noise_of_the_star_it_is_as_good(changed):
    other = load_rig(default_rig_path(), [changed])
    found = delay.analyse(other, swings(other))
    assert found.stamp_error_s == pytest.approx(-SHOWN_LATE_S, abs=0.0001)
    assert found.left < 0.6 * delay._MOST_LEFT


def test_the_delay_is_the_median_from_true_exposure_to_command(result):
    assert result.delay_s == pytest.approx(0.035 + 0.0005 * np.log(2) + SHOWN_LATE_S, abs=0.0001)
    assert result.jitter_s == pytest.approx(0.0005, rel=0.3)


@pytest.mark.parametrize("stamp_error_s", [-0.0471, 0.0033, 0.0124])
def test_wrong_stamps_are_found_wrong_by_as_much(rig, record, stamp_error_s):
    stamps_s = record.tick["mid_exposure_s"] - stamp_error_s
    result = delay.analyse(rig, with_ticks(record, mid_exposure_s=stamps_s))
    assert result.stamp_error_s == pytest.approx(stamp_error_s - SHOWN_LATE_S, abs=0.0001)
    assert result.delay_s == pytest.approx(0.0356, abs=0.0002)


def test_twice_the_hysteresis_is_not_taken_for_delay():
    rig = load_rig(default_rig_path(), ["plant.loops.right.hysteresis.loop_width_fraction=0.30"])
    result = delay.analyse(rig, swings(rig, seed=3))
    assert result.stamp_error_s == pytest.approx(-SHOWN_LATE_S, abs=0.0001)


def test_frames_that_average_their_exposure_are_told_from_instants(rig):
    result = delay.analyse(rig, swings(rig, seed=1, exposure_s=rig.camera.exposure_s))
    assert result.blurred
    assert result.stamp_error_s == pytest.approx(-SHOWN_LATE_S, abs=0.0002)


def test_lost_frames_are_bridged(rig, record):
    without = np.random.default_rng(0).uniform(size=len(record.tick["star_az_px"])) < 0.05
    changes = {
        name: np.where(without, np.nan, record.tick[name]) for name in ("star_az_px", "star_el_px")
    }
    result = delay.analyse(rig, with_ticks(record, **changes))
    assert result.stamp_error_s == pytest.approx(-SHOWN_LATE_S, abs=0.0001)
    assert result.frames == np.count_nonzero(~without)


def test_the_fragment_makes_a_rig_with_the_measured_delay(rig, result):
    document = rig.model_dump()
    document["camera"] |= result.fragment()["camera"]
    assert rig_from_document(document, "test").camera.frame_delay_s == result.delay_s


def test_the_plan_stays_on_the_mirrors_diamond(rig):
    loop = rig.loops["right"]
    most_px = loop.fsm.range_rad * scales(rig, loop).mirror_px_per_rad
    drives = delay.plan(rig, "right")
    for time_s in np.arange(0, experiment_s(drives), 0.01):
        assert np.abs(channel_values(drives, FSM, float(time_s))).sum() <= most_px / 2


def test_a_still_mirror_tells_nothing(rig, record):
    still = dataclasses.replace(record, injected_v=np.full_like(record.injected_v, 5.0))
    with pytest.raises(IdentifyError, match="not moved"):
        delay.analyse(rig, still)


def test_frames_that_do_not_show_the_motion_are_refused(rig, record):
    elsewhere_px = np.random.default_rng(0).normal(20, 2, (2, len(record.tick["star_az_px"])))
    with pytest.raises(IdentifyError, match="delay: "):
        delay.analyse(
            rig, with_ticks(record, star_az_px=elsewhere_px[0], star_el_px=elsewhere_px[1])
        )


def test_an_experiment_that_ended_soon_is_refused(rig, record):
    soon = {name: values[:250] for name, values in record.tick.items()}
    with pytest.raises(IdentifyError, match="run to its end"):
        delay.analyse(rig, dataclasses.replace(record, tick=soon))


def test_a_lost_star_is_refused(rig, record):
    nowhere = np.full_like(record.tick["star_az_px"], np.nan)
    with pytest.raises(IdentifyError, match="0 frames with the star"):
        delay.analyse(rig, with_ticks(record, star_az_px=nowhere))


def test_the_plot_is_drawn(result, tmp_path):
    result.draw().savefig(tmp_path / "delay.png")
    assert (tmp_path / "delay.png").stat().st_size > 1000
    assert any("ms" in line for line in result.lines())


@pytest.mark.timeout(60)
def test_voltages_that_come_hours_apart_are_refused(rig, record):
    rows = np.arange(0, len(record.injected_s), 500)
    rare = dataclasses.replace(
        record,
        injected_s=record.injected_s[0] + 1e6 * np.arange(len(rows)),
        injected_v=record.injected_v[rows],
    )
    with pytest.raises(IdentifyError, match=r"expected|no time shift"):
        delay.analyse(rig, rare)
