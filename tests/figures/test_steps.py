import numpy as np
import pytest

from fitctl.figures.motion import Held
from fitctl.figures.steps import AZ, EL, STEP_AT_S, star_step, step_response


@pytest.fixture(scope="module")
def near(rig):
    return star_step(rig, "right", 0, (0.0, 3.0), 20.0)


@pytest.mark.long
def test_the_star_truly_jumps_and_in_one_axis_only(near):
    before, jumped = np.searchsorted(near.time_s, [STEP_AT_S - 0.1, STEP_AT_S])
    moved_px = near.star_px[jumped] - near.star_px[before]

    assert moved_px[EL] == pytest.approx(3.0, abs=0.2)
    assert abs(moved_px[AZ]) < 0.2


@pytest.mark.long
def test_the_mirror_answers_first_and_the_siderostat_takes_over(near):
    soon, late = np.searchsorted(near.time_s, [STEP_AT_S + 1.0, STEP_AT_S + 19.0])

    assert near.mirror_px[soon, EL] < -2.0
    assert abs(near.motor_px[soon, EL]) < 0.1
    assert near.motor_px[late, EL] < -0.3
    assert near.mirror_command_px[late, EL] > near.mirror_command_px[soon, EL]


def test_backlash_keeps_the_true_siderostat_behind_its_command(near):
    gap_px = np.abs(near.motor_px - near.motor_command_px)[:, EL]

    assert gap_px.max() > 0.02
    assert gap_px.max() < 0.4  # 0.37 px of backlash


def test_a_step_within_range_is_judged_without_leaving_vernier(near):
    found = step_response(near, EL, STEP_AT_S, within_px=0.1)

    assert found.modes == "VERNIER"
    assert 0.1 < found.settled_s < 10.0
    assert found.saturated_s == 0.0


@pytest.mark.long
def test_a_step_beyond_the_mirror_goes_through_coarse_and_comes_back(rig):
    found = step_response(
        star_step(rig, "right", 0, (-20.0, 0.0), 25.0), AZ, STEP_AT_S, within_px=0.1
    )

    assert found.modes == "VERNIER COARSE VERNIER"
    assert found.settled_s < 20.0
    assert 0.0 < found.saturated_s < 1.0


@pytest.mark.long
def test_a_target_off_the_frame_is_refused(rig):
    held = Held(rig, "right", 0, history_s=2.0)

    with pytest.raises(RuntimeError, match="must lie in"):
        held.target_jumps((40.0, 0.0))
