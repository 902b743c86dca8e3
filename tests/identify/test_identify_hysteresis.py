import dataclasses
import tomllib

import numpy as np
import pytest
import tomli_w
from plant_records import record_of

from fitctl.config import StackHysteresis, default_rig_path, load_rig, rig_from_document
from fitctl.identify import hysteresis
from fitctl.identify.errors import IdentifyError
from fitctl.identify.plays import trail
from fitctl.model.drives import STACKS, channel_values, experiment_s
from fitctl.model.hysteresis import half_widths_v, hysteresis_output, stack_gains, swept_stroke
from fitctl.model.plant import Plant

pytestmark = pytest.mark.long

FULL_V = 10.0


@pytest.fixture(scope="session")
def record(rig):
    return record_of(rig, "right", hysteresis.plan(rig, "right"), seed=1)


@pytest.fixture(scope="session")
def result(rig, record):
    return hysteresis.analyse(rig, record)


def motions():
    """Full and minor loops, here and there, after a full sweep."""
    part = np.linspace(0, 1, 1500)
    swept = np.concatenate([np.linspace(0, FULL_V, 50), np.linspace(FULL_V, 0, 50)])
    loops = [
        5 - 5 * np.cos(4 * np.pi * part),
        5 + 5 * (1 - part) * np.sin(40 * np.pi * part),
        7.5 + 1.0 * np.sin(10 * np.pi * part),
        2.0 + 1.5 * np.sin(10 * np.pi * part),
    ]
    return swept, np.concatenate(loops)


def output_errors(rig, result):
    """Of each stack, RMS about a constant, as a part of the stroke."""
    truth = rig.plant.loops["right"].hysteresis
    true_gains = stack_gains(truth, rig.loops["right"].fsm)
    swept, volts = motions()
    volts = np.concatenate([swept, volts])[:, None]
    expected = hysteresis_output(trail(volts, half_widths_v(truth)), true_gains)
    found = hysteresis_output(trail(volts, result.half_widths_v)[:, :1], result.gains_m_per_v)
    stroke_m = swept_stroke(half_widths_v(truth), true_gains, FULL_V)
    return np.std((found - expected)[len(swept) :], axis=0) / stroke_m


def test_the_model_gives_the_plants_output_within_half_a_percent(rig, result):
    assert np.all(output_errors(rig, result) < 0.0025)
    assert np.all(result.output_sd < 0.0025)
    assert result.excess < 1.2


@pytest.mark.parametrize("changed", ["camera.electrons_per_dn=1.0", "loops.right.sensor=fit"])
def test_with_another_noise_of_the_star_it_is_as_good(changed):
    other = load_rig(default_rig_path(), [changed])
    found = hysteresis.analyse(
        other, record_of(other, "right", hysteresis.plan(other, "right"), seed=1)
    )
    assert np.all(output_errors(other, found) < 0.0025)
    assert found.excess < 1.2


def test_it_does_not_matter_what_the_stacks_did_before(rig):
    plant = Plant(rig, [5], star_offset_px=np.zeros((1, 2))).stellar_loops["right"]
    for second, volts in enumerate([[9.0, 1.0, 5.0], [0.5, 8.0, 9.5], [5.0, 5.0, 5.0]]):
        plant.inputs.stack_v[0] = volts
        plant.advance(second + 1.0)
    record = record_of(rig, "right", hysteresis.plan(rig, "right"), seed=5, plant=plant)
    assert np.all(output_errors(rig, hysteresis.analyse(rig, record)) < 0.0025)


def test_wrong_time_stamps_are_seen_and_do_not_spoil_the_model(rig, record):
    late = record.tick | {"mid_exposure_s": record.tick["mid_exposure_s"] + 0.003}
    found = hysteresis.analyse(rig, dataclasses.replace(record, tick=late))
    assert found.late_s == pytest.approx(-0.003, abs=0.0005)
    assert np.all(output_errors(rig, found) < 0.0025)


def test_lost_frames_cost_little(rig, record):
    kept = np.random.default_rng(0).uniform(size=len(record.star_px)) > 0.05
    tick = {name: values.copy() for name, values in record.tick.items()}
    tick["star_az_px"][~kept] = tick["star_el_px"][~kept] = np.nan
    found = hysteresis.analyse(rig, dataclasses.replace(record, tick=tick))
    assert np.all(output_errors(rig, found) < 0.003)


# ---------------------------------------------------------------- the plan


def test_the_plan_takes_every_stack_over_its_whole_range_within_three_minutes(rig):
    drives = hysteresis.plan(rig, "right")
    times_s = np.arange(0.0, experiment_s(drives), 0.01)
    volts = 5 + np.array([channel_values(drives, STACKS, time_s) for time_s in times_s])
    assert volts.min(axis=0) == pytest.approx(np.zeros(3), abs=0.2)
    assert volts.max(axis=0) == pytest.approx(np.full(3, FULL_V), abs=0.2)
    assert experiment_s(drives) < 180


def test_the_star_stays_where_the_window_fits(rig, record):
    assert all(rig.camera.window_fits(*star_px) for star_px in record.star_px)


def test_a_target_at_the_frames_edge_is_refused(rig):
    document = rig.model_dump()
    document["loops"]["right"]["target_px"] = {"az": 5.0, "el": 19.5}
    with pytest.raises(
        IdentifyError, match=r"must stay on the frame; move loops\.right\.target_px"
    ):
        hysteresis.plan(rig_from_document(document, "test"), "right")


# ---------------------------------------------------------------- what comes out


def test_the_fragment_goes_through_toml_into_the_rig(rig, result):
    fragment = tomllib.loads(tomli_w.dumps(result.fragment()))
    section = fragment["loops"]["right"]["fsm"]["hysteresis"]
    known = StackHysteresis.model_validate(section)
    assert np.array_equal(known.gains_m_per_v, result.gains_m_per_v)
    assert np.array_equal(known.half_widths_v, result.half_widths_v)
    assert len(known.half_widths_v) == 13

    document = rig.model_dump()
    document["loops"]["right"]["fsm"]["hysteresis"] = section
    assert rig_from_document(document, "test").loops["right"].fsm.hysteresis == known


def test_an_operator_reads_stroke_and_width_of_every_stack(result):
    lines = result.lines()
    assert lines[1].startswith("stack 2: stroke 9.")
    assert "loop 1" in lines[1]
    assert "ms late on the voltages" in lines[3]


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_a_plot_is_drawn(result, tmp_path, suffix):
    result.draw().savefig(tmp_path / f"loops.{suffix}")
    assert (tmp_path / f"loops.{suffix}").stat().st_size > 10_000


# ---------------------------------------------------------------- what is refused


def test_a_record_without_motion_is_refused(rig):
    still = record_of(rig, "right", [], extra_s=20.0)
    with pytest.raises(
        IdentifyError, match=r"a stack moved by 0\.00 V only, expected at least 5 V"
    ):
        hysteresis.analyse(rig, still)


def test_a_record_with_the_star_lost_is_refused(rig, record):
    tick = record.tick | {"star_az_px": record.tick["star_az_px"].copy()}
    tick["star_az_px"][2000:3000] = np.nan
    with pytest.raises(IdentifyError, match=r"the star is on \d+ of \d+ frames, .* run it again"):
        hysteresis.analyse(rig, dataclasses.replace(record, tick=tick))
