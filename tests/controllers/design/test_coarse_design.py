import math

import numpy as np
import pytest

from fitctl.controllers.design.coarse import (
    SERVO_BANDWIDTH_HZ,
    limit_cycles,
    onset,
    phase_margin_deg,
    prefilter_design,
    siderostat_response,
)
from fitctl.controllers.design.eq20 import eq20_zpk
from fitctl.controllers.design.linear_loop.loopshape import compensator_response

HALF_WIDTH_PX = 0.185


def swing(basis, gain_hz, start_px, half_width_px=HALF_WIDTH_PX, duration_s=40.0, step_s=0.001):
    """The coarse loop alone on its play, delay and servo, in small steps: amplitude in the end."""
    per_frame, late = round(basis.period_s / step_s), round(basis.delay_s / step_s)
    wn = 2 * math.pi * SERVO_BANDWIDTH_HZ
    setpoint = motor = start_px
    beam, speed, walk, commands, end = start_px - half_width_px, 0.0, 0.0, {}, []
    for step in range(round(duration_s / step_s)):
        if step % per_frame == 0:
            commands[step + late] = -2 * math.pi * gain_hz * basis.period_s * beam
        walk = commands.pop(step) / per_frame if step in commands else walk
        setpoint += walk
        speed += step_s * (wn**2 * (setpoint - motor) - 1.4 * wn * speed)
        motor += step_s * speed
        beam = max(motor - half_width_px, min(motor + half_width_px, beam))
        if step * step_s > duration_s - 5.0:
            end.append(beam)
    return max(end) - min(end)


@pytest.fixture(scope="module")
def alone(fit):
    return onset(limit_cycles(fit))


def test_below_the_predicted_gain_a_swing_dies(fit, alone):
    assert swing(fit, 0.85 * alone.gain_hz, start_px=3.0) < 0.05


def test_above_it_a_swing_feeds_itself(fit, alone):
    assert swing(fit, 1.15 * alone.gain_hz, start_px=3.0) > 2 * HALF_WIDTH_PX


def test_fits_own_gain_is_far_below_any_limit_cycle(fit, alone):
    gain_hz = fit.coarse_per_s / (2 * math.pi)
    assert gain_hz == pytest.approx(0.074, abs=1e-3)
    beside = onset(limit_cycles(fit, compensator_response(*eq20_zpk())))
    assert gain_hz < 0.05 * beside.gain_hz
    assert swing(fit, gain_hz, start_px=1.0, duration_s=60.0) < 0.05


def test_the_papers_tenth_of_a_hertz_is_not_where_its_own_model_swings(fit, alone):
    assert alone.gain_hz > 4.0
    assert swing(fit, 0.2, start_px=1.0, duration_s=60.0) < 0.05


def test_the_play_lowers_the_gain_at_which_the_loop_swings_but_a_little(fit, alone):
    omega = 2 * math.pi * np.geomspace(1, 20, 20_000)
    loop = siderostat_response(fit)(omega)
    turn = np.abs(np.unwrap(np.angle(loop)) + math.pi).argmin()
    without_play_hz = 1 / abs(loop[turn]) / (2 * math.pi)
    assert 0.9 * without_play_hz < alone.gain_hz < without_play_hz


def test_a_swing_just_above_the_half_width_has_hardly_any_margin_at_any_gain(fit):
    for gain_hz in (0.02, 0.074, 0.5):
        margins = [phase_margin_deg(fit, gain_hz, a) for a in (1.01, 1.05, 1.5, 5.0, 50.0)]
        assert margins == sorted(margins)
        assert margins[0] < 10
        assert margins[-1] > 70


def test_beside_the_vernier_at_work_it_swings_at_a_lower_gain(fit, alone):
    beside = onset(limit_cycles(fit, compensator_response(*eq20_zpk())))
    assert beside.gain_hz < alone.gain_hz


def test_the_prefilters_numbers_are_those_of_its_step_response(fit):
    found = prefilter_design(fit, 1.0)
    t = np.linspace(0, 10, 100_001)
    step = 1 - (1 + t) * np.exp(-t)
    assert found.fastest_per_s == pytest.approx(np.gradient(step, t).max(), rel=1e-4)
    assert found.settling_s == pytest.approx(t[np.abs(step - 1) > 0.02][-1], abs=1e-3)
    assert abs(1 / (1 + 2j * math.pi * found.bandwidth_hz) ** 2) == pytest.approx(0.5**0.5)
