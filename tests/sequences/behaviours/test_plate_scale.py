"""Plate scale: matrices that are known come back, and what cannot be believed is refused."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl import Instrument
from fitctl.config import Loop, default_rig_path, load_rig
from fitctl.model.optics import rotation
from fitctl.model.optics import scales as true_scales
from fitctl.sequences.behaviours.plate_scale import (
    PlateScaleFit,
    axis_gains,
    corrections,
    fit_plate_scale,
    modelled_px,
    plan,
    refusal,
    rotation_deg,
    rotation_sd_deg,
    scale_of,
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


def written_for(rig, folder):
    """What the fragment that the step writes has for the right loop."""
    with Instrument(rig, simulate=True, seed=1) as instrument:
        instrument.acquire()
        instrument.wait(5.0)
        instrument.plate_scale(attempts=2)
        (path,) = instrument.write_calibrations(folder)
    return tomllib.loads(path.read_text())["loops"]["right"]


@pytest.mark.long
def test_gains_of_the_axes_are_measured_and_the_fragment_undoes_them(tmp_path):
    rig = load_rig(default_rig_path(), UNEVEN)
    written = written_for(rig, tmp_path)
    screw = RIG.loops["right"].siderostat.ball_screw_m_per_rad
    scale = {
        "siderostat": written["siderostat"]["ball_screw_m_per_rad"] / screw,
        "fsm": 1.0,  # with a known hysteresis, beam_per_mirror stays
    }
    gains = {stage: np.array(written[stage]["axis_gains"]) for stage in scale}
    for stage, truth in (("siderostat", SIDEROSTAT_TRUTH), ("fsm", FSM_TRUTH)):
        turn = rotation(written[stage]["rotation_deg"])
        assert scale[stage] * turn @ gains[stage] == pytest.approx(np.array(truth), abs=0.03), stage
    assert np.linalg.det(gains["siderostat"]) == pytest.approx(1.0, abs=1e-3)


def gains_of(matrix, deviation, before=None):
    return axis_gains(matrix, deviation, scale_of(matrix), before)


def test_axes_of_one_gain_have_none_in_the_fragment():
    even = turned(0.93, 0.3)
    deviation = np.full((2, 2), 0.005)

    assert gains_of(even, deviation) is None
    assert gains_of(even @ np.diag([1.01, 1.0]), deviation) is None
    assert gains_of(even @ np.diag([1.1, 1.0]), deviation) is not None
    assert gains_of(even @ np.diag([1.1, 1.0]), 10 * deviation) is None


def test_gains_in_the_rig_file_are_replaced_by_the_identity_where_the_axes_are_even():
    stale = [[1.1, 0.0], [0.0, 0.909]]

    assert gains_of(np.eye(2), np.full((2, 2), 0.005), stale) == [[1.0, 0.0], [0.0, 1.0]]


DEVIATION = np.full((2, 2), 0.005)


def loop_with(fsm=None, siderostat=None, *, hysteresis=True):
    """The loop of a rig file with other keys of its stages."""
    loop = RIG.loops["right"].model_dump()
    loop["fsm"] |= fsm or {}
    loop["siderostat"] |= siderostat or {}
    if not hysteresis:
        loop["fsm"]["hysteresis"] = None
    return Loop.model_validate(loop)


def response_of(loop):
    """By how much a loop's stages move a star, as its rig file has it, in px: mirror, siderostat."""
    scale = true_scales(RIG.model_copy(update={"loops": {"right": loop}}), loop)
    return scale.mirror_px(np.eye(2)).T, scale.motor_px(np.eye(2)).T


def measured(mirror_px, siderostat_px, loop):
    """The fit of a star that a radian of the stages moves by these matrices, with the loop's rig file."""
    scale = true_scales(RIG, loop)
    return PlateScaleFit(
        mirror_px / scale.mirror_px_per_rad,
        siderostat_px / scale.motor_px_per_rad,
        DEVIATION,
        DEVIATION,
        0.05,
    )


gain_values = st.floats(0.7, 1.4)
cross_values = st.floats(-0.15, 0.15)
gain_matrices = st.builds(
    lambda a, b, c, d: [[a, b], [c, d]], gain_values, cross_values, cross_values, gain_values
)


def stages(**scalar):
    """Tables of a stage: a scale, a rotation, and gains or none."""
    turn = {
        "rotation_deg": st.floats(-180.0, 180.0),
        "axis_gains": st.none() | st.just([[1.0, 0.0], [0.0, 1.0]]) | gain_matrices,
    }
    return st.fixed_dictionaries(turn | scalar)


mirrors = stages(beam_per_mirror=st.floats(1.6, 2.4))
siderostats = stages(ball_screw_m_per_rad=st.floats(1e-4, 1.3e-4))


@given(mirrors, siderostats, mirrors, siderostats, st.booleans())
@pytest.mark.long
def test_with_its_fragment_any_rig_file_has_the_measured_response(
    fsm, siderostat, true_fsm, true_siderostat, hysteresis
):
    loop = loop_with(fsm, siderostat, hysteresis=hysteresis)
    truth = response_of(loop_with(true_fsm, true_siderostat))

    found, _ = corrections(loop, measured(*truth, loop))

    again = loop_with(fsm | found["fsm"], siderostat | found["siderostat"], hysteresis=hysteresis)
    assert ("beam_per_mirror" in found["fsm"]) != hysteresis
    before = {"fsm": loop.fsm.axis_gains, "siderostat": loop.siderostat.axis_gains}
    for stage, px, true_px in zip(before, response_of(again), truth, strict=True):
        # Without gains before, and with even axes, none are written: less than 2 % is the stacks'.
        within = 1e-3 if "axis_gains" in found[stage] else 0.03
        assert np.abs(px - true_px).max() <= within * scale_of(true_px), stage
        assert before[stage] is None or "axis_gains" in found[stage]


def test_a_scale_in_the_gains_of_the_rig_file_is_not_applied_twice():
    """As commissioning's step `mirror` writes it: 0.85 in `axis_gains`, and `beam_per_mirror` at 2.0."""
    fsm = {"axis_gains": [[0.85, 0.0], [0.0, 0.85]]}
    loop = loop_with(fsm, hysteresis=False)

    found, _ = corrections(loop, measured(*response_of(loop), loop))

    assert found["fsm"]["beam_per_mirror"] == pytest.approx(1.7)
    assert found["fsm"]["axis_gains"] == [[1.0, 0.0], [0.0, 1.0]]


def test_with_a_known_hysteresis_the_gains_keep_the_mirrors_scale():
    loop = loop_with({"axis_gains": [[0.935, 0.0], [0.0, 0.765]]})

    found, lines = corrections(loop, measured(*response_of(loop), loop))

    assert found["fsm"] == {"rotation_deg": 0.0, "axis_gains": [[0.935, 0.0], [0.0, 0.765]]}
    assert "the mirror's axis_gains include its scale; beam_per_mirror is unchanged" in lines


@pytest.mark.long
@pytest.mark.parametrize("amplitude_px", [1.0, 5.0])
def test_a_known_hysteresis_is_no_scale_at_any_amplitude(amplitude_px):
    """By Eq. 1 the mirror moves 0.87 times as far as it should at 1 px, and 1.12 times at 5 px."""
    with Instrument(RIG, simulate=True, seed=1) as instrument:
        instrument.acquire()
        instrument.wait(5.0)
        found = instrument.plate_scale(
            attempts=2, amplitude_px=amplitude_px, max_offset_px=6.0, max_error=0.1
        )
        (calibration,) = instrument._runner.calibrations

    assert found["fsm_scale"] == pytest.approx(1.0, abs=0.03)
    assert list(calibration.fragment["loops"]["right"]["fsm"]) == ["rotation_deg"]


def test_the_modelled_motion_of_a_mirror_is_that_of_its_channels_and_ends_with_them():
    moved_px = modelled_px(RIG.loops["right"].fsm, DRIVES, TIME_S, SCALE.mirror_px_per_rad)
    az, el = DRIVES[:2]
    swinging = slice(*np.searchsorted(TIME_S, [2 / az.frequency_hz, az.duration_s]))
    ended = np.searchsorted(TIME_S, el.start_s + el.duration_s + 0.1)

    az_range, el_range = np.ptp(moved_px[swinging], axis=0)
    assert az_range == pytest.approx(2 * az.amplitude, rel=0.15)
    assert el_range < 0.1 * az_range
    assert np.ptp(moved_px[ended:], axis=0) == pytest.approx(np.zeros(2))


@pytest.mark.long
def test_gains_of_the_rig_file_that_are_wrong_are_found_out(tmp_path):
    """The axes are even, and the rig file has other gains: the fragment has to name the even ones."""
    wrong = [[1.1, 0.0], [0.0, 0.909]]
    even = [[1.0, 0.0], [0.0, 1.0]]
    rig = load_rig(
        default_rig_path(),
        [f"loops.right.{stage}.axis_gains={wrong}" for stage in ("siderostat", "fsm")]
        + [f"plant.loops.right.{stage}_axis_gains={even}" for stage in ("siderostat", "fsm")],
    )
    written = written_for(rig, tmp_path)
    for stage in ("siderostat", "fsm"):
        assert np.array(written[stage]["axis_gains"]) == pytest.approx(np.eye(2), abs=0.03), stage


@pytest.mark.long
def test_with_a_known_hysteresis_no_scale_is_written_where_it_agrees():
    with Instrument(RIG, simulate=True, seed=1) as instrument:
        instrument.acquire()
        instrument.plate_scale(attempts=2)
        (calibration,) = instrument._runner.calibrations

    loop = calibration.fragment["loops"]["right"]
    assert "ball_screw_m_per_rad" in loop["siderostat"]
    assert list(loop["fsm"]) == ["rotation_deg"]
    assert "the mirror's scale agrees with fsm.hysteresis" in "\n".join(calibration.lines)


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
