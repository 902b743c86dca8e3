"""A learnt design at work beside the one before it, on the same frames."""

import dataclasses

import numpy as np
import pytest

from benchmarks.linear_loop import held
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.linear_loop.on_paper import SETTLE_S
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.loop.comparison import WATCHES, comparison
from fitctl.model.optics import scales

NOISE_PX = 0.03
SECONDS = 60.0


@pytest.fixture(scope="module")
def rig():
    return load_rig(default_rig_path())


@pytest.fixture(scope="module")
def noisy(rig):
    return dataclasses.replace(basis(rig, "right"), noise_px=NOISE_PX)


def with_air(night, times):
    """The night with an air path that moves the star so many times as far."""
    air = night.air_path.model_copy(update={"gain_px": times * night.air_path.gain_px})
    return dataclasses.replace(night, air_path=air)


def followed(rig, truth, learnt, compared, seed, seconds=SECONDS):
    """Whether a comparison sends the loop back, on frames of a loop with the learnt design."""
    error_px, series = held(truth, learnt, seconds, seed)
    scale = scales(rig, rig.stellar_loops["right"])
    # What all stages did counts as the siderostat's.
    stages_px = error_px - series.disturbance_px
    motors_rad = np.linalg.solve(scale.siderostat_turn, stages_px.T).T / scale.motor_px_per_rad
    for error, motor_rad in zip(error_px, motors_rad, strict=True):
        compared.observe(tuple(error), np.zeros(2), motor_rad)
        if compared.why_back:
            return compared.why_back
    return ""


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_noise_does_not_hide_a_design_that_is_worse(rig, noisy, seed):
    """The residual is 4.8 % larger; on frames that is 1.7 %, for most of it is noise."""
    truth = with_air(noisy, 0.95)
    learnt, before = design_minimum_variance(with_air(noisy, 0.6)), design_minimum_variance(truth)

    whys = [
        followed(rig, truth, learnt, comparison(rig, "right", learnt, before, noise_px), seed)
        for noise_px in (NOISE_PX, 0.0)
    ]
    assert "besides the noise" in whys[0]
    assert whys[1] == ""


@pytest.mark.parametrize("seed", range(3))
def test_a_design_that_is_better_stays(rig, noisy, seed):
    truth = with_air(noisy, 0.6)
    learnt, before = design_minimum_variance(truth), design_minimum_variance(with_air(noisy, 0.95))
    compared = comparison(rig, "right", learnt, before, NOISE_PX)

    assert followed(rig, truth, learnt, compared, seed) == ""


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("times", "goes_back"), [(0.95, True), (0.6, False)])
def test_a_design_that_gains_nothing_is_left_after_a_minute(rig, noisy, seed, times, goes_back):
    truth, before = with_air(noisy, times), design_minimum_variance(with_air(noisy, 0.95))
    learnt = design_minimum_variance(truth)
    seconds = SETTLE_S + WATCHES[-1][0]

    def why(seconds):
        compared = comparison(rig, "right", learnt, before, NOISE_PX)
        return followed(rig, truth, learnt, compared, seed, seconds)

    assert why(seconds - 1.0) == ""
    assert ("over 60 s" in why(seconds + 1.0)) == goes_back


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("gain", "goes_back"), [(0.8, True), (1.0, False)])
def test_a_mirror_that_moves_much_less_must_gain_more(rig, noisy, seed, gain, goes_back):
    """4 % less on paper is too little where the hysteresis is so unlike the rig file's."""
    on_mirror = dataclasses.replace(noisy, mirror_gain=gain)
    truth, stronger = with_air(on_mirror, 0.6), with_air(on_mirror, 0.95)
    learnt, before = design_minimum_variance(truth), design_minimum_variance(stronger)
    compared = comparison(rig, "right", learnt, before, NOISE_PX)

    assert bool(followed(rig, truth, learnt, compared, seed, SETTLE_S + 61.0)) == goes_back


@pytest.mark.parametrize("seed", range(3))
def test_a_design_for_another_air_is_left_within_a_quarter_of_a_minute(rig, noisy, seed):
    """The residual is more than 20 % larger, as after the air has become weak at once."""
    quiet = dataclasses.replace(noisy, noise_px=0.01)
    truth = with_air(quiet, 0.5)
    learnt, before = design_minimum_variance(with_air(quiet, 3.0)), design_minimum_variance(truth)
    compared = comparison(rig, "right", learnt, before, 0.01)

    assert "over 10 s" in followed(rig, truth, learnt, compared, seed, SETTLE_S + 10.5)


def test_a_design_that_is_unstable_on_the_learnt_ones_mirror_is_not_compared(rig, noisy):
    learnt = design_minimum_variance(dataclasses.replace(noisy, mirror_gain=1.9))

    assert comparison(rig, "right", learnt, design_for(rig, "right", "eq20"), NOISE_PX) is None
    assert comparison(rig, "right", learnt, learnt, NOISE_PX) is not None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_with_a_known_alias_designs_are_compared_by_what_they_leave_in_truth(rig, noisy, seed):
    """48.9 Hz looks like 1.1 Hz on frames, where only the design that knows it leaves it alone."""
    quiet = dataclasses.replace(noisy, noise_px=0.003)
    truth = dataclasses.replace(quiet, lines=(Line(48.9, 0.002, 0.05),))
    knows = dataclasses.replace(design_minimum_variance(truth), learnt=True)
    before = design_minimum_variance(quiet)
    compared = comparison(rig, "right", knows, before, 0.003)
    knows_no_line = dataclasses.replace(knows, parameters=knows.parameters | {"lines": []})
    on_frames = comparison(rig, "right", knows_no_line, before, 0.003)

    assert followed(rig, truth, knows, compared, seed) == ""
    assert "over 10 s" in followed(rig, truth, knows, on_frames, seed)
