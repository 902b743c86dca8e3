"""Plate scale: matrices that are known come back, and what cannot be believed is refused."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl import Instrument
from fitctl.config import default_rig_path, load_rig
from fitctl.model.optics import rotation
from fitctl.model.optics import scales as true_scales
from fitctl.sequences.behaviours.plate_scale import (
    axis_gains,
    fit_plate_scale,
    plan,
    refusal,
    rotation_deg,
    rotation_sd_deg,
    swing_of,
)
from fitctl.sequences.steps import PlateScale
from fitctl.sequences.view import StepFailed

RIG = load_rig(default_rig_path())
SCALE = true_scales(RIG, RIG.loops["right"])
STEP = PlateScale()
DRIVES = plan(STEP, RIG, "right")
TIME_S = np.arange(0.0, DRIVES[-1].start_s + DRIVES[-1].duration_s, 0.02)


def behind_play(moved, width):
    out = np.empty_like(moved)
    last = 0.0
    for row, now in enumerate(moved):
        last = max(now - width / 2, min(now + width / 2, last))
        out[row] = last
    return out


def star_of(mirror, siderostat, *, play_px=0.37, noise_px=0.02, drift_px=0.5, seed=0):
    """A star that both stages move, each behind a play, on drifting air."""
    rng = np.random.default_rng(seed)
    swings = [swing_of(drive, TIME_S) for drive in DRIVES]
    played = np.column_stack([behind_play(swing.moved_px, play_px) for swing in swings])
    slow = drift_px * np.column_stack([np.sin(0.31 * TIME_S), np.cos(0.17 * TIME_S)])
    matrix = np.hstack([mirror, siderostat])
    return swings, played @ matrix.T + slow + noise_px * rng.standard_normal((len(TIME_S), 2))


def turned(scale, angle_rad):
    return scale * rotation(np.degrees(angle_rad))


scales = st.floats(0.5, 1.5)
angles = st.floats(-np.pi, np.pi)


@pytest.mark.long
@settings(max_examples=25)
@given(scales, angles, scales, angles, st.floats(0.0, 0.5))
def test_matrices_that_are_known_come_back(
    mirror_scale, mirror_rad, siderostat_scale, siderostat_rad, play_px
):
    mirror = turned(mirror_scale, mirror_rad)
    siderostat = turned(siderostat_scale, siderostat_rad)
    swings, star_px = star_of(mirror, siderostat, play_px=play_px)

    fit = fit_plate_scale(TIME_S, star_px, swings)

    anyhow = STEP.model_copy(update={"max_rotation_deg": 180.0})
    assert refusal(fit, anyhow, SCALE) == ""
    np.testing.assert_allclose(fit.mirror, mirror, atol=0.01)
    np.testing.assert_allclose(fit.siderostat, siderostat, atol=0.01)


@pytest.mark.long
def test_the_uncertainty_is_that_of_repeated_fits():
    fits = []
    for seed in range(30):
        swings, star_px = star_of(np.eye(2), np.eye(2), noise_px=0.3, seed=seed)
        fits.append(fit_plate_scale(TIME_S, star_px, swings))

    scatter = np.std([fit.mirror for fit in fits], axis=0)
    claimed = np.mean([fit.mirror_sd for fit in fits], axis=0)

    assert np.all(claimed > 0.6 * scatter)
    assert np.all(claimed < 1.6 * scatter)
    scatter_deg = np.std([rotation_deg(fit.mirror) for fit in fits])
    claimed_deg = np.mean([rotation_sd_deg(fit.mirror, fit.mirror_sd) for fit in fits])
    assert 0.6 * scatter_deg < claimed_deg < 1.6 * scatter_deg


def test_frames_without_a_star_are_left_out():
    swings, star_px = star_of(np.eye(2), np.eye(2))
    star_px[::3] = np.nan

    fit = fit_plate_scale(TIME_S, star_px, swings)

    np.testing.assert_allclose(fit.mirror, np.eye(2), atol=0.01)


@pytest.mark.parametrize(
    ("mirror", "siderostat", "options", "said"),
    [
        (np.eye(2), np.diag([1.0, 0.05]), {}, "siderostat: does not move the star along both axes"),
        (np.zeros((2, 2)), np.eye(2), {}, "mirror: does not move the star"),
        (np.eye(2), np.eye(2), {"noise_px": 1.0}, "px RMS are unexplained"),
        (np.eye(2), np.eye(2), {"noise_px": 0.45, "play_px": 0.0}, "a scale is uncertain by"),
    ],
)
def test_a_fit_that_cannot_be_believed_is_refused(mirror, siderostat, options, said):
    swings, star_px = star_of(mirror, siderostat, **options)
    strict = STEP.model_copy(update={"max_error": 0.003})

    assert said in refusal(fit_plate_scale(TIME_S, star_px, swings), strict, SCALE)


def test_too_few_frames_are_refused():
    swings, star_px = star_of(np.eye(2), np.eye(2))
    star_px[100:] = np.nan

    with pytest.raises(StepFailed, match="expected at least"):
        fit_plate_scale(TIME_S, star_px, swings)


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_a_rig_file_that_is_wrong_is_found_out(tried, scale):
    """The siderostat truly moves the star `scale` times as far as the rig file says."""
    run = tried()
    lever_arm_m = RIG.loops["right"].siderostat.lever_arm_m * scale
    siderostat = "loops.right.siderostat"
    overrides = [
        f"{siderostat}.lever_arm_m={lever_arm_m}",
        f"{siderostat}.device.position_limit_rad=100.0",
    ]
    run.rig = load_rig(default_rig_path(), overrides)

    run({"step": "acquire"}, {"step": "wait", "duration_s": 10.0}, {"step": "plate_scale"})

    assert run.outcomes() == ["done"] * 3
    found = run.figures()
    assert found["siderostat_scale"] == pytest.approx(scale, rel=0.02)
    assert found["fsm_scale"] == pytest.approx(1.0, rel=0.02)
    assert abs(found["siderostat_rotation_deg"]) < 1.0


@pytest.mark.long
def test_the_scales_that_are_measured_correct_the_rig_file(tmp_path):
    loop = RIG.loops["right"]
    fsm = loop.fsm.model_copy(update={"hysteresis": None})
    rig = RIG.model_copy(update={"loops": {"right": loop.model_copy(update={"fsm": fsm})}})
    with Instrument(rig, simulate=True, seed=1) as instrument:
        truth = instrument._link._simulation.plants["right"].constants.packed
        truth["mirror_px_per_rad"] *= 0.93
        truth["motor_px_per_rad"] *= 1.06
        instrument.acquire()
        instrument.wait(10.0)
        instrument.plate_scale(attempts=2)
        (path,) = instrument.write_calibrations(tmp_path)

    found = tomllib.loads(path.read_text())["loops"]["right"]
    assert path.name == "fit-mock-right-plate-scale.toml"
    # The stacks' own gain at this swing is within a few percent of stack_scale_m_per_v.
    assert found["fsm"]["beam_per_mirror"] == pytest.approx(0.93 * fsm.beam_per_mirror, rel=0.05)
    assert found["siderostat"]["ball_screw_m_per_rad"] == pytest.approx(
        1.06 * loop.siderostat.ball_screw_m_per_rad, rel=0.01
    )


@pytest.mark.long
def test_a_camera_that_is_turned_is_measured_within_the_stated_uncertainty(tmp_path):
    """The rig file says 25 and 35 degrees; the camera stands at 30. The fragment then holds the star."""
    said_deg, truth_deg = {"siderostat": 25.0, "fsm": 35.0}, 30.0
    rig = load_rig(
        default_rig_path(),
        [f"loops.right.{stage}.rotation_deg={deg}" for stage, deg in said_deg.items()],
    )
    with Instrument(rig, simulate=True, seed=1) as instrument:
        truth = instrument._link._simulation.plants["right"].constants.packed
        truth["siderostat_turn"] = truth["mirror_turn"] = rotation(truth_deg)
        instrument.acquire()
        instrument.wait(5.0)
        found = instrument.plate_scale(attempts=2)
        (path,) = instrument.write_calibrations(tmp_path)

    written = tomllib.loads(path.read_text())["loops"]["right"]
    for stage in said_deg:
        sd_deg = found[f"{stage}_rotation_sd_deg"]
        assert sd_deg < 0.3
        assert written[stage]["rotation_deg"] == pytest.approx(truth_deg, abs=3 * sd_deg)


SIDEROSTAT_TRUTH = [[1.15, 0.06], [-0.04, 0.9]]
FSM_TRUTH = [[0.88, 0.0], [0.05, 1.1]]
UNEVEN = [
    f"plant.loops.right.siderostat_axis_gains={SIDEROSTAT_TRUTH}",
    f"plant.loops.right.fsm_axis_gains={FSM_TRUTH}",
]


@pytest.mark.long
def test_gains_of_the_axes_are_measured_and_the_fragment_undoes_them(tmp_path):
    rig = load_rig(default_rig_path(), UNEVEN)
    with Instrument(rig, simulate=True, seed=1) as instrument:
        instrument.acquire()
        instrument.wait(5.0)
        instrument.plate_scale(attempts=2)
        (path,) = instrument.write_calibrations(tmp_path)

    written = tomllib.loads(path.read_text())["loops"]["right"]
    screw = RIG.loops["right"].siderostat.ball_screw_m_per_rad
    found = {
        "siderostat": written["siderostat"]["ball_screw_m_per_rad"] / screw,
        "fsm": np.sqrt(np.linalg.det(FSM_TRUTH)),  # its scale is its hysteresis'
    }
    for (stage, scale), truth in zip(found.items(), (SIDEROSTAT_TRUTH, FSM_TRUTH), strict=True):
        gains = np.array(written[stage]["axis_gains"])
        assert np.linalg.det(gains) == pytest.approx(1.0, abs=1e-3)
        turn = rotation(written[stage]["rotation_deg"])
        assert scale * turn @ gains == pytest.approx(np.array(truth), abs=0.03), stage


def test_axes_of_one_gain_have_none_in_the_fragment():
    even = turned(0.93, 0.3)
    deviation = np.full((2, 2), 0.005)

    assert axis_gains(even, deviation) is None
    assert axis_gains(even @ np.diag([1.01, 1.0]), deviation) is None
    assert axis_gains(even @ np.diag([1.1, 1.0]), deviation) is not None
    assert axis_gains(even @ np.diag([1.1, 1.0]), 10 * deviation) is None


@pytest.mark.long
def test_a_known_hysteresis_is_not_corrected_by_a_scale():
    with Instrument(RIG, simulate=True, seed=1) as instrument:
        instrument.acquire()
        instrument.plate_scale(attempts=2)
        (calibration,) = instrument._runner.calibrations

    loop = calibration.fragment["loops"]["right"]
    assert "ball_screw_m_per_rad" in loop["siderostat"]
    assert list(loop["fsm"]) == ["rotation_deg"]
    assert "identify fsm.hysteresis again" in "\n".join(calibration.lines)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (rotation(50.0), "turned by +50.0 deg from the rig file's rotation_deg; max_rotation_deg is 45"),
        (np.diag([1.0, -1.0]), "and mirrored; max_rotation_deg is 45"),
    ],
)  # fmt: skip
def test_a_stage_that_is_turned_too_far_or_mirrored_is_refused(matrix, said):
    swings, star_px = star_of(np.eye(2), matrix)

    fit = fit_plate_scale(TIME_S, star_px, swings)

    assert "siderostat: " in refusal(fit, STEP, SCALE)
    assert said in refusal(fit, STEP, SCALE)
