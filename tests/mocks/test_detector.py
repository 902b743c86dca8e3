import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.mocks.detector import NOISE_V, DetectorBench
from fitctl.model import hysteresis, structure
from fitctl.model.detector import DETECTOR_RANGE_V, SAMPLE_RATE_HZ, mirror_angles_seen
from fitctl.model.optics import mirror_from_stacks, stack_volts

ARCSEC = 1 / ARCSEC_PER_RAD
STIFF = "plant.loops.right.structure.participation=0.0"
QUIET_V = 5 * NOISE_V


def bench_with(*overrides):
    return DetectorBench(load_rig(default_rig_path(), overrides), "right")


def sine(frequency_hz, amplitude_rad, duration_s):
    time_s = np.arange(round(duration_s * SAMPLE_RATE_HZ)) / SAMPLE_RATE_HZ
    return amplitude_rad * np.sin(2 * np.pi * frequency_hz * time_s)


def test_at_rest_the_detector_reads_zero_and_its_noise():
    seen_v = bench_with().measure("az", np.zeros(4000))
    assert np.abs(seen_v.mean(axis=0)).max() < NOISE_V / 5
    assert seen_v.std(axis=0) == pytest.approx([NOISE_V] * 2, rel=0.1)


def test_a_slow_motion_of_one_axis_stays_in_that_axis():
    seen_rad = mirror_angles_seen(bench_with().measure("el", sine(5, 7.2 * ARCSEC, 1.0)))
    assert np.ptp(seen_rad[:, 1]) == pytest.approx(2 * 7.2 * ARCSEC, rel=0.2)
    assert np.ptp(seen_rad[:, 0]) < 0.1 * ARCSEC


@settings(max_examples=25)
@given(
    wanted=st.lists(st.floats(-1.4e-4, 1.4e-4), min_size=1, max_size=60),
    axis=st.sampled_from(["az", "el"]),
)
def test_any_motion_goes_through_the_stacks_as_the_model_has_it(rig, wanted, axis):
    """However the mock cuts it: the model is evaluated here one sample after the other."""
    fsm, truth = rig.loops["right"].fsm, rig.plant.loops["right"].hysteresis
    half_v, gains = hysteresis.half_widths_v(truth), hysteresis.stack_gains(truth, fsm)
    plays_v = hysteresis.play(np.zeros((3, len(half_v))), np.array(fsm.bias_v), half_v)
    rest_m = plays_v @ gains
    expected_rad = []
    for value in wanted:
        mirror_rad = np.array([value, 0.0] if axis == "az" else [0.0, value])
        volts = stack_volts(mirror_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
        plays_v = hysteresis.play(plays_v, volts[:, None], half_v)
        expected_rad.append(mirror_from_stacks(plays_v @ gains - rest_m, fsm.stack_radius_m))
    seen_rad = mirror_angles_seen(bench_with(STIFF).measure(axis, np.array(wanted)))
    assert seen_rad == pytest.approx(
        np.array(expected_rad), abs=mirror_angles_seen(np.array(QUIET_V))
    )


def test_the_mount_rings_at_its_modes_as_much_as_the_structure_says(rig):
    """Driven at the first mode, both axes answer with the plant's own response."""
    seen_rad = mirror_angles_seen(bench_with().measure("az", sine(330, 3 * ARCSEC, 1.0)))[6400:]
    flat_rad = mirror_angles_seen(bench_with(STIFF).measure("az", sine(330, 3 * ARCSEC, 1.0)))[
        6400:
    ]
    response = structure.frequency_response(rig.plant.loops["right"].structure, np.array([330.0]))[
        0
    ]
    ratio = seen_rad.std(axis=0) / flat_rad[:, 0].std()
    assert ratio == pytest.approx(np.abs(response[:, 0]), rel=0.02)


def test_hysteresis_is_remembered_from_one_measurement_to_the_next():
    bench = bench_with()
    bench.measure("az", np.linspace(0, 30 * ARCSEC, 2000))
    left_rad = mirror_angles_seen(bench.measure("az", np.zeros(2000)))[1000:, 0].mean()
    assert left_rad > ARCSEC


def test_the_detector_ends_at_its_range():
    seen_v = bench_with().measure("az", sine(330, 30 * ARCSEC, 0.5))
    assert np.abs(seen_v).max() == DETECTOR_RANGE_V


def test_one_seed_gives_one_measurement(rig):
    drive_rad = sine(40, 7.2 * ARCSEC, 0.1)
    first, second = (DetectorBench(rig, "right", seed=3).measure("az", drive_rad) for _ in range(2))
    assert np.array_equal(first, second)
