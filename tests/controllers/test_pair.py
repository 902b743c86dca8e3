import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import CONTROLLERS
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.eq20 import design_eq20, eq20_zpk, tustin
from fitctl.controllers.pair import Measurement, Pair
from fitctl.model.optics import saturate_diamond, scales

PERIOD_S = 0.02
PX_PER_RAD = 2 * 0.457 / 24e-6
RANGE_RAD = 1.772e-4
NO_LIMIT_RAD = 1e6


class Vernier:
    """Eq. 20's pair, as if there were nothing but a star and a mirror."""

    def __init__(self, rig, range_rad=RANGE_RAD, design=None):
        design = design or design_eq20(basis(rig, "right"))
        self.pair = Pair(design, scales(rig, rig.loops["right"]), range_rad)

    def step(self, error_px):
        nothing = np.zeros(2)
        return self.pair.step(Measurement(error_px, nothing, nothing, nothing)).mirror_rad


def eq20_discrete(period_s):
    zeros, poles, gain = eq20_zpk()
    return tustin(tuple(zeros), tuple(poles), gain, period_s)


def eq20():
    zeros, poles, gain = eq20_zpk()
    return control.zpk(zeros, poles, gain)


def eq20_response(s):
    """Eq. 20 at complex frequencies, straight from its zeros and poles."""
    zeros, poles, gain = eq20_zpk()
    s = np.asarray(s)[:, None]
    return gain * np.prod(s - zeros, axis=1) / np.prod(s - poles, axis=1)


# ---------------------------------------------------------------- Eq. 20 and the loop of Eq. 16


def test_the_compensators_constant_is_26_75():
    assert eq20_response(np.zeros(1))[0].real == pytest.approx(26.75, abs=5e-3)


def test_the_compensator_is_printed_as_eq_20():
    s = 1j * np.logspace(-2, 2, 50)
    printed = 18.3 * (s + 25) * (s + 4.5) / ((s + 15.6) * (s + 4.4) * (s + 1.2))
    printed *= (s + 0.5) * (s**2 + 5.5 * s + 37.2) * (s**2 + 5.98 * s + 39.5)
    printed /= (s + 0.44) * (s**2 + 5.9 * s + 39.1) * (s**2 + 3.8 * s + 39.9)
    assert eq20_response(s) == pytest.approx(printed, rel=1e-12)


@pytest.fixture(scope="module")
def loop_of_eq_16(rig):
    """Both stages behind the frame delay: frequencies in rad/s and open-loop response."""
    loop = rig.loops["right"]
    metres_per_rad = scales(rig, loop).motor_px_per_rad * rig.camera.pixel_size_m
    coarse_rad_s = loop.coarse.gain_rad_per_m * metres_per_rad
    omega = np.logspace(-1, 2.3, 20_000)
    both = (eq20() + control.zpk([], [0.0], coarse_rad_s))(1j * omega)
    return omega, both * np.exp(-1j * omega * rig.camera.frame_delay_s)


@pytest.mark.long
def test_the_loop_of_eq_16_has_the_margins_computed_for_it(loop_of_eq_16):
    omega, response = loop_of_eq_16
    gain, phase_deg, closest, _, crossover, _ = control.stability_margins(
        control.FRD(response, omega)
    )
    assert crossover / (2 * math.pi) == pytest.approx(3.7, abs=0.05)
    assert phase_deg == pytest.approx(28, abs=1.0)
    assert 20 * math.log10(gain) == pytest.approx(5.4, abs=0.1)
    assert 1 / closest == pytest.approx(2.76, abs=0.03)


def test_a_disturbance_of_1_hz_is_attenuated_6_6_times(loop_of_eq_16):
    omega, response = loop_of_eq_16
    at_1_hz = response[np.abs(omega - 2 * math.pi).argmin()]
    assert abs(1 + at_1_hz) == pytest.approx(6.6, abs=0.1)


# ---------------------------------------------------------------- discretized


def test_the_discrete_compensator_is_the_tustin_image_of_eq_20():
    a, b, c, d = eq20_discrete(PERIOD_S)
    assert a.shape == (8, 8)
    for frequency_hz in np.geomspace(0.001, 24.9, 60):
        z = np.exp(2j * np.pi * frequency_hz * PERIOD_S)
        discrete = c @ np.linalg.solve(z * np.eye(8) - a, b) + d
        warped = 2 / PERIOD_S * (z - 1) / (z + 1)
        assert discrete == pytest.approx(eq20_response([warped])[0], rel=1e-8)


@pytest.mark.parametrize("period_s", [0.002, 0.02, 0.04])
def test_the_discrete_compensator_is_stable_and_keeps_its_constant(period_s):
    a, b, c, d = eq20_discrete(period_s)
    assert np.abs(np.linalg.eigvals(a)).max() < 1.0
    assert c @ np.linalg.solve(np.eye(8) - a, b) + d == pytest.approx(26.75, abs=5e-3)


def test_the_vernier_is_the_compensator_of_each_axis(rig):
    vernier = Vernier(rig, NO_LIMIT_RAD)
    errors_px = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    mirror_px = np.array([vernier.step(error) for error in errors_px]) * PX_PER_RAD
    compensator = control.sample_system(control.ss(eq20()), PERIOD_S, method="bilinear")
    for axis in range(2):
        expected = control.forced_response(compensator, inputs=errors_px[:, axis]).outputs
        assert mirror_px[:, axis] == pytest.approx(-expected, abs=1e-9)


# ---------------------------------------------------------------- deadzone feedback, Fig. 10


@given(errors=st.lists(st.tuples(st.floats(-40, 40), st.floats(-40, 40)), min_size=1, max_size=60))
def test_the_mirror_is_never_told_to_leave_the_diamond(rig, errors):
    vernier = Vernier(rig)
    for error_px in errors:
        mirror_rad = vernier.step(np.array(error_px))
        assert np.abs(mirror_rad).sum() <= RANGE_RAD * (1 + 1e-12)


def test_within_reach_the_deadzone_does_nothing(rig):
    limited = Vernier(rig)
    free = Vernier(rig, NO_LIMIT_RAD)
    for error_px in np.random.default_rng(1).uniform(-0.1, 0.1, (300, 2)):
        assert np.array_equal(limited.step(error_px), free.step(error_px))
        assert not limited.pair.saturated


class WindingUp(Vernier):
    """The same compensator and limit, without the feedback."""

    def __init__(self, rig):
        super().__init__(rig, NO_LIMIT_RAD)

    def step(self, error_px):
        return saturate_diamond(super().step(error_px), RANGE_RAD)


def residual_after_a_jump(vernier, jump_px, jump_frames, after_frames):
    """Star under the mirror, two frames late: held off by `jump_px`, then let go; |error| after that."""
    in_force = [np.zeros(2), np.zeros(2)]
    residual_px = []
    for frame in range(jump_frames + after_frames):
        star_px = jump_px if frame < jump_frames else np.zeros(2)
        error_px = star_px + PX_PER_RAD * in_force[-2]
        in_force.append(vernier.step(error_px))
        residual_px.append(np.linalg.norm(error_px))
    return np.array(residual_px[jump_frames + 2 :])


def frames_until_within(residual_px, limit_px):
    outside = np.flatnonzero(residual_px > limit_px)
    return 0 if outside.size == 0 else int(outside[-1]) + 1


@pytest.mark.parametrize("jump_px", [(30.0, 0.0), (-20.0, 22.0)])
def test_after_ten_seconds_out_of_reach_the_mirror_recovers_without_wind_up(rig, jump_px):
    jump = np.array(jump_px)
    limited = Vernier(rig)
    recovered = residual_after_a_jump(limited, jump, jump_frames=500, after_frames=1500)
    wound_up = residual_after_a_jump(WindingUp(rig), jump, jump_frames=500, after_frames=1500)
    assert frames_until_within(recovered, 0.1) * PERIOD_S < 2.0
    assert frames_until_within(wound_up, 0.1) > 3 * frames_until_within(recovered, 0.1)
    assert not limited.pair.saturated


def test_it_says_when_it_is_saturated(rig):
    vernier = Vernier(rig)
    for _ in range(50):
        vernier.step(np.array([30.0, 0.0]))
    assert vernier.pair.saturated
    vernier.pair.start(np.zeros(2), np.zeros(2), np.zeros(2))
    assert not vernier.pair.saturated
    assert vernier.step(np.zeros(2)).tolist() == [0.0, 0.0]


# ---------------------------------------------------------------- taking over from another design


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("held_px", [(1.0, -0.5), (-3.0, 2.0)])
def test_a_design_takes_the_mirror_over_where_it_is(rig, name, held_px):
    scale = scales(rig, rig.loops["right"])
    pair = Pair(DESIGNS[name](basis(rig, "right")), scale, RANGE_RAD)
    held_rad = np.array(held_px) / scale.mirror_px_per_rad
    motor_rad, target_px = np.array([5.0, -3.0]), np.array([24.0, 19.5])
    pair.start(held_rad, motor_rad, target_px)

    first = pair.step(Measurement(np.zeros(2), target_px, held_rad, motor_rad))

    bump_px = (first.mirror_rad - held_rad) * scale.mirror_px_per_rad
    # What a design works from, an error in pixels, is not there at the first tick: it gives little.
    assert np.abs(bump_px).max() < 0.03 * np.abs(held_px).max()


def test_every_controller_that_can_be_named_can_be_made():
    assert tuple(DESIGNS) == CONTROLLERS
