"""Vibration lines in a star's motion: their spectrum, their drift, and the plant that has them."""

import math

import numpy as np
import pytest
from scipy.signal import welch

from fitctl.config import ConfigError, Line, default_rig_path, load_rig
from fitctl.model.compiled import compiled
from fitctl.model.lines import line_kicks, line_motion, line_states, line_table
from fitctl.model.plant import Plant

STEP_S, STEPS = 5e-4, 10
STILL_AIR = "plant.loops.right.air_path.gain_px=0.0"


def line(**changed):
    usual = {
        "frequency_hz": 6.0,
        "rms_px": 0.05,
        "direction_deg": 0.0,
        "damping": 0.02,
        "drift_hz_per_min": 0.0,
    }
    return Line(**(usual | changed))


def motion_px(one, nodes, key=1, move=line_motion):
    table = line_table([one])
    moved = np.zeros((nodes * STEPS, 2))
    kicks = line_kicks(key, 0, nodes, 1)
    compiled(move)(table, line_states(table, key), kicks, 0.0, STEPS, STEP_S, moved)
    return moved


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def toml(*lines):
    tables = (
        "{" + ", ".join(f"{key} = {value}" for key, value in one.model_dump().items()) + "}"
        for one in lines
    )
    return f"plant.loops.right.lines=[{', '.join(tables)}]"


def plant_with(*overrides, runs=1):
    rig = rig_with(STILL_AIR, *overrides)
    return Plant(rig, range(runs), star_offset_px=np.zeros((runs, 2))).stellar_loops["right"]


def pointing_px(plant, until_s):
    plant.advance(until_s)
    spots_px = plant.history_px(0.0, until_s)[:, :, 0]
    return spots_px - plant.constants.spot_origin_px[:, 0]


# ---------------------------------------------------------------- one line


@pytest.mark.long
def test_a_lines_spectrum_is_that_of_an_oscillator_which_white_noise_drives():
    one = line(frequency_hz=20.0, damping=0.05)
    moved = motion_px(one, 100_000)[:, 0]  # 500 s

    frequency_hz, measured = welch(moved, fs=1 / STEP_S, nperseg=8192)

    omega, s = 2 * math.pi * one.frequency_hz, 2j * math.pi * frequency_hz
    gain = 2 * omega * one.rms_px * math.sqrt(one.damping * omega)
    expected = 2 * np.abs(gain / (s**2 + 2 * one.damping * omega * s + omega**2)) ** 2
    ratio = measured / expected
    segments = 2 * len(moved) / 8192 / 1.5  # half-overlapped Hann segments are not independent
    for low_hz, high_hz in [(3, 12), (12, 18), (18, 22), (22, 30), (30, 80)]:
        band = (frequency_hz >= low_hz) & (frequency_hz < high_hz)
        independent = segments * band.sum() / 1.5
        assert ratio[band].mean() == pytest.approx(1.0, abs=4 / math.sqrt(independent) + 0.02)


@pytest.mark.long
@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_a_line_has_its_rms_along_its_direction(damping):
    one = line(frequency_hz=10.0, damping=damping, direction_deg=30.0)

    moved = motion_px(one, 60_000)  # 300 s

    along_px = moved @ [math.cos(math.pi / 6), math.sin(math.pi / 6)]
    across_px = moved @ [-math.sin(math.pi / 6), math.cos(math.pi / 6)]
    # Of a Gaussian with this bandwidth; a sine has it exactly.
    scatter = 0.002 if damping == 0 else 1 / math.sqrt(2 * math.pi * 10 * damping * 300)
    assert np.std(along_px) == pytest.approx(0.05, rel=3 * scatter)
    assert np.abs(across_px).max() < 1e-15


def test_a_line_begins_as_it_goes_on():
    table = line_table([line(damping=0.1)])
    begins = np.array([line_states(table, key)[0, 0] for key in range(2000)])

    assert np.std(begins) == pytest.approx(1.0, rel=4 / math.sqrt(2 * 2000))
    assert np.mean(begins) == pytest.approx(0.0, abs=4 / math.sqrt(2000))


@pytest.mark.long
def test_a_sine_is_a_sine_of_any_phase():
    moved = motion_px(line(frequency_hz=48.9, damping=0.0), 2000)[:, 0]
    time_s = np.arange(1, len(moved) + 1) * STEP_S
    basis = np.column_stack([np.cos(2 * np.pi * 48.9 * time_s), np.sin(2 * np.pi * 48.9 * time_s)])

    parts, *_ = np.linalg.lstsq(basis, moved, rcond=None)

    assert np.abs(moved - basis @ parts).max() < 1e-9
    assert np.hypot(*parts) == pytest.approx(0.05 * math.sqrt(2), rel=1e-9)


@pytest.mark.long
def test_a_line_drifts_and_its_motion_does_not_jump():
    moved = motion_px(line(damping=0.0, drift_hz_per_min=6.0), 24_000)[:, 0]  # 120 s

    crossings = np.flatnonzero((moved[:-1] < 0) & (moved[1:] >= 0)) * STEP_S
    frequency_hz = 1 / np.diff(crossings)
    assert frequency_hz[:20].mean() == pytest.approx(6.0, rel=0.05)
    assert frequency_hz[-20:].mean() == pytest.approx(18.0, rel=0.05)
    fastest_px = 2 * math.pi * 18 * 0.05 * math.sqrt(2) * STEP_S
    assert np.abs(np.diff(moved)).max() < 1.01 * fastest_px


def test_a_line_that_drifts_down_stays_above_zero():
    moved = motion_px(line(damping=0.01, drift_hz_per_min=-600.0), 4000)

    assert np.isfinite(moved).all()


# ---------------------------------------------------------------- the plant


def test_the_plants_star_moves_by_its_lines_and_all_spots_alike():
    plant = plant_with(toml(line(frequency_hz=6.0, damping=0.0)))

    moved = pointing_px(plant, 10.0)[:, 0]

    assert moved.std(axis=0) == pytest.approx([0.05, 0.0], abs=1e-3)
    spots = plant.history_px(0.0, 10.0)[:, 0]
    apart = spots[:, 1] - spots[:, 0]
    assert np.ptp(apart, axis=0) == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_a_sine_that_replaces_a_damped_line_has_its_own_rms(seed):
    later = toml(line(frequency_hz=10.0, damping=0.0)).removeprefix("plant.loops.right.")
    rig = rig_with(
        STILL_AIR,
        toml(line(damping=0.2)),
        f"plant.timeline=[{{at_s=1.0, loops={{right={{{later}}}}}}}]",
    )
    plant = Plant(rig, [seed], star_offset_px=np.zeros((1, 2))).stellar_loops["right"]
    moved_px = pointing_px(plant, 4.0)[-4000:, 0, 0]  # 2 s

    assert moved_px.std() == pytest.approx(0.05, rel=1e-3)


def test_lines_follow_from_the_seed_and_change_nothing_else():
    still, again = (pointing_px(plant_with(toml(line())), 2.0) for _ in range(2))
    beside_others = pointing_px(plant_with(toml(line()), runs=3), 2.0)

    rigs = rig_with(), rig_with(toml(line()))
    offset_px = np.zeros((1, 2))
    plants = [Plant(rig, [0], star_offset_px=offset_px).stellar_loops["right"] for rig in rigs]
    without_px, with_px = (pointing_px(plant, 2.0) for plant in plants)

    assert np.array_equal(still, again)
    assert np.array_equal(beside_others[:, :1], still)
    assert with_px - without_px == pytest.approx(still, abs=1e-12)


def test_lines_of_two_runs_are_independent():
    moved = pointing_px(plant_with(toml(line(frequency_hz=50.0, damping=0.2)), runs=2), 20.0)

    # 20 s with a bandwidth of 30 Hz: some 600 independent looks
    assert np.corrcoef(moved[..., 0].T)[0, 1] == pytest.approx(0.0, abs=4 / math.sqrt(600))


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"frequency_hz": 1000.0}, "frequency_hz must be below 1000, half the rate of step_s"),
        ({"frequency_hz": 0.0}, "lines.0.frequency_hz: must be greater than 0"),
        ({"damping": 0.6}, "lines.0.damping: must be less than or equal to 0.5"),
    ],
)
def test_a_line_that_cannot_be_is_an_error(changed, expected):
    wrong = line().model_copy(update=changed)

    with pytest.raises(ConfigError) as error:
        rig_with(toml(wrong))

    assert expected in str(error.value)
