from functools import partial

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from model.plant_references import bind_reference

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.controllers.position_servo import PositionServo
from fitctl.model.compiled import numba_installed
from fitctl.model.optics import piston_m, scales, stack_volts
from fitctl.model.plant import Plant
from fitctl.model.plant_step import PlantState, PlantTrace, bound_step

STILL_AIR = "plant.loops.right.air_path.gain_px=0.0"
STRAIGHT_STACKS = [
    "plant.loops.right.hysteresis.loop_width_fraction=0.0",
    "plant.loops.right.hysteresis.full_swing_stroke_m=8.0e-6",  # SF_PZT times 10 V
]
seeds = st.integers(0, 2**31)


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def plant_with(*overrides, seeds=(0,), **kwargs):
    offsets = np.zeros((len(seeds), 2))
    return Plant(rig_with(*overrides), seeds, star_offset_px=offsets, **kwargs).stellar_loops[
        "right"
    ]


def from_target(plant, rig, time_s):
    target = rig.loops["right"].target_px
    return plant.spots_px(time_s)[:, 0] - [target.az, target.el]


# ---------------------------------------------------------------- one result, however it is computed


NEEDS_NUMBA = pytest.mark.skipif(
    not numba_installed(), reason="numba is not installed (extra `fast`)"
)
STEPS = [pytest.param(True, marks=NEEDS_NUMBA, id="compiled"), pytest.param(False, id="plain")]


@pytest.mark.parametrize("machine_code", STEPS)
@settings(max_examples=15)
@given(
    seed=seeds,
    runs=st.integers(1, 3),
    steps=st.integers(1, 60),
    turned_deg=st.sampled_from([(0.0, 0.0), (30.0, 30.0), (-70.0, 120.0)]),
)
def test_the_step_does_what_the_reference_does(machine_code, seed, runs, steps, turned_deg):
    siderostat_deg, mirror_deg = turned_deg
    rig = rig_with(
        f"loops.right.siderostat.rotation_deg={siderostat_deg}",
        f"loops.right.fsm.rotation_deg={mirror_deg}",
    )
    random = np.random.default_rng(seed)
    plant = Plant(rig, range(runs)).stellar_loops["right"]
    state = plant.state
    for array, scale in (
        (state.motor_rad, 5.0), (state.motor_rad_s, 50.0), (state.beam_motor_rad, 5.0),
        (state.plays_v, 5.0), (state.modes, 1e-4), (state.velocity_rad_s, 50.0),
    ):  # fmt: skip
        array[:] = scale * random.standard_normal(array.shape)
    state.stack_v[:] = random.uniform(0, 10, (runs, 3))
    air_px = 0.3 * random.standard_normal((steps + 5, runs, 2, 2))
    outcomes = []
    for bind in (partial(bound_step, machine_code=machine_code), bind_reference):
        own = PlantState(runs, state.plays_v.shape[-1])
        own.rows[:], own.plays_v[:] = state.rows, state.plays_v
        trace = PlantTrace(np.zeros((steps + 3, runs, 2, 2)), np.zeros((steps + 3, runs)))
        bind(plant.constants, own, air_px, trace)(steps + 6, steps)
        outcomes.append(
            (
                *trace,
                own.plays_v,
                *(own.rows[name] for name in own.rows.dtype.names if name != "stacks_at_v"),
            )
        )
    for found, reference in zip(*outcomes, strict=True):
        assert found == pytest.approx(reference, rel=1e-9, abs=1e-12)


@pytest.mark.long
@settings(max_examples=20)
@given(cuts=st.lists(st.integers(1, 1500), max_size=12))
@example(cuts=[21])  # compiled, the steps after an odd cut round otherwise
def test_the_motion_does_not_depend_on_how_the_time_is_cut(rig, cuts):
    plants = [Plant(rig, [7]).stellar_loops["right"] for _ in range(2)]
    for plant in plants:
        plant.inputs.velocity_rad_s[:] = [3.0, -2.0]
        plant.inputs.stack_v[:] = [4.0, 5.5, 6.0]
    for step in sorted(cuts):
        plants[1].advance(step * plants[1].constants.step_s)
    for plant in plants:
        plant.advance(0.75)
    whole, cut = (
        (plant.history_px(0.0, 0.75), plant.history_piston_m(0.0, 0.75)) for plant in plants
    )
    assert cut[0] == pytest.approx(whole[0], rel=0, abs=1e-12)
    assert np.array_equal(cut[1], whole[1])


@pytest.mark.parametrize("machine_code", STEPS)
def test_a_run_does_not_depend_on_the_runs_beside_it(rig, machine_code, monkeypatch):
    monkeypatch.setattr("fitctl.model.plant_step.numba_installed", lambda: machine_code)
    together, alone = (
        Plant(rig, [3, 4, 5]).stellar_loops["right"],
        Plant(rig, [4]).stellar_loops["right"],
    )
    for plant in (together, alone):
        plant.inputs.velocity_rad_s[:] = [3.0, -2.0]
    assert together.spots_px(0.5)[1] == pytest.approx(alone.spots_px(0.5)[0], abs=1e-12)


def test_a_seed_is_a_run(rig):
    first, again, other = (
        Plant(rig, [seed]).stellar_loops["right"].spots_px(1.0) for seed in (5, 5, 6)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_the_star_is_placed_all_over_the_configured_disc(rig):
    plant = Plant(rig, range(300)).stellar_loops["right"]
    truth = rig.plant.loops["right"]
    radius_px = truth.star_offset_sky_arcsec_max / scales(rig, rig.loops["right"]).sky_arcsec_per_px
    distance = np.linalg.norm(from_target(plant, rig, 0.0005), axis=1) / radius_px
    assert distance.max() < 1.02  # the air path moves it a little
    assert np.mean(distance < np.sqrt(0.5)) == pytest.approx(0.5, abs=0.12)  # half the area


# ---------------------------------------------------------------- time


def test_time_already_reached_changes_nothing(rig):
    plant = Plant(rig, [0]).stellar_loops["right"]
    before = plant.spots_px(0.1).copy()
    plant.advance(0.05)
    assert plant.time_s == pytest.approx(0.1)
    assert np.array_equal(plant.spots_px(0.1), before)


def test_the_past_can_be_asked_for_as_long_as_the_history_holds():
    plant = plant_with("plant.history_s=1.0")
    early = plant.spots_px(0.9).copy()
    plant.advance(1.5)
    assert np.array_equal(plant.spots_px(0.9), early)
    assert plant.oldest_s == pytest.approx(0.5005)
    plant.spots_px(plant.oldest_s)
    with pytest.raises(ValueError, match=r"history begins at 0\.501 s, asked for 0\.500 s"):
        plant.spots_px(0.5)
    assert len(plant.history_px(0.0, 9.0)) == 2000


def test_a_history_is_every_grid_time_of_its_span(rig):
    plant = Plant(rig, [0, 1]).stellar_loops["right"]
    plant.advance(0.2)
    history = plant.history_px(0.1, 0.15)
    assert history.shape == (101, 2, 2, 2)
    assert np.array_equal(history[0], plant.spots_px(0.1))
    assert np.array_equal(history[-1], plant.spots_px(0.15))


def test_a_rig_of_real_hardware_has_no_plant(rig):
    real = rig.model_copy(update={"plant": None, "mocks": None})
    with pytest.raises(ConfigError, match="sections plant and mocks are missing"):
        Plant(real, [0]).stellar_loops["right"]


# ---------------------------------------------------------------- what the devices do to the star


@pytest.mark.parametrize("turn_rad", [(1e-4, 0.0), (0.0, 1e-4), (-8e-5, 9e-5)])
def test_dac_volts_move_the_star_by_the_right_pixels(rig, turn_rad):
    plant = plant_with(STILL_AIR, *STRAIGHT_STACKS)
    fsm, scale = rig.loops["right"].fsm, scales(rig, rig.loops["right"])
    plant.inputs.stack_v[0] = stack_volts(
        np.array(turn_rad), fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v
    )
    moved_px = from_target(plant, rig, 0.5)[0]  # the modes have rung down
    assert moved_px == pytest.approx(scale.mirror_px_per_rad * np.array(turn_rad), abs=1e-3)


def test_at_the_bias_the_star_rests_where_it_was_placed(rig):
    assert from_target(plant_with(STILL_AIR), rig, 0.1)[0] == pytest.approx(0.0, abs=1e-9)


def test_motors_follow_velocity_commands_with_the_amplifiers_lag(rig):
    plant = plant_with(STILL_AIR)
    plant.inputs.velocity_rad_s[0] = [10.0, -4.0]
    plant.advance(1.0)
    lag_s = 1 / (2 * np.pi * rig.plant.loops["right"].amplifier_bandwidth_hz)
    assert plant.state.motor_rad[0] == pytest.approx(np.array([10.0, -4.0]) * (1.0 - lag_s))
    assert plant.state.motor_rad_s[0] == pytest.approx([10.0, -4.0])


def test_after_a_reversal_the_star_stands_still_for_the_width_of_the_backlash(rig):
    plant = plant_with(STILL_AIR)
    scale = scales(rig, rig.loops["right"])
    plant.inputs.velocity_rad_s[0, 0] = 1.0
    plant.advance(1.0)
    plant.inputs.velocity_rad_s[0, 0] = -1.0
    motor_px, star_px = [], []
    for time_s in np.arange(2000, 2400) * plant.constants.step_s:
        star_px.append(from_target(plant, rig, time_s)[0, 0])
        motor_px.append(scale.motor_px_per_rad * plant.state.motor_rad[0, 0])
    at_rest = np.flatnonzero(np.array(star_px) == max(star_px))
    stood_still_px = motor_px[at_rest[0]] - motor_px[at_rest[-1]]
    backlash_px = rig.plant.loops["right"].backlash_sky_arcsec / scale.sky_arcsec_per_px
    assert stood_still_px == pytest.approx(backlash_px, abs=2 * 1.0 * scale.motor_px_per_rad * 5e-4)
    assert star_px[-1] < star_px[0]  # and then it follows


def test_fringe_and_pointing_spot_move_together(rig):
    plant = plant_with(STILL_AIR)
    spot = rig.plant.loops["right"].spots[1]
    plant.inputs.velocity_rad_s[0] = [2.0, 1.0]
    pointing, fringe = plant.spots_px(1.0)[0]
    assert fringe - pointing == pytest.approx([spot.offset_px.az, spot.offset_px.el])


def test_piston_is_that_of_eq_4_from_the_stacks_true_displacements(rig):
    plant = plant_with(STILL_AIR)
    plant.inputs.stack_v[0] = [8.0, 3.0, 6.5]
    plant.advance(0.1)
    radius_m = rig.loops["right"].fsm.stack_radius_m
    piston = piston_m(plant.state.displacement_m[0], radius_m)
    assert plant.history_piston_m(0.0, 0.1)[-1, 0] == pytest.approx(piston, rel=1e-6)
    assert abs(piston) > 1e-7


def test_a_spots_own_air_does_not_depend_on_how_many_spots_there_are(rig):
    spots = rig.plant.loops["right"].spots
    loop = rig.plant.loops["right"].model_copy(update={"spots": spots[:1]})
    alone = rig.model_copy(
        update={"plant": rig.plant.model_copy(update={"loops": {"right": loop}})}
    )
    pointing = [Plant(one, [3]).stellar_loops["right"].spots_px(0.7)[0, 0] for one in (rig, alone)]
    assert pointing[0] == pytest.approx(pointing[1], abs=1e-12)


def test_the_position_servo_has_40_to_50_hz_of_bandwidth_on_the_plant(rig):
    plant = plant_with(STILL_AIR)
    siderostat = rig.loops["right"].siderostat
    period_s = 1 / siderostat.servo.rate_hz
    servo = PositionServo(
        siderostat.servo.gain_per_s,
        siderostat.velocity_limit_rad_s,
        siderostat.acceleration_limit_rad_s2,
        period_s,
        period_s,
    )
    step_rad = 0.02  # small enough for no limit to be met
    servo.move_to((step_rad, 0.0))
    position_rad, trail = (0.0, 0.0), []
    for period in range(500):
        velocity_rad_s = servo.step(position_rad)
        plant.advance(period * period_s)
        plant.inputs.velocity_rad_s[0] = velocity_rad_s
        # Read as the command is given: it will be used one period later.
        position_rad = tuple(plant.state.motor_rad[0].tolist())
        trail.append(position_rad[0] / step_rad)
    assert trail[-1] == pytest.approx(1.0, abs=1e-6)
    impulse_response = np.diff(trail, prepend=0.0)
    frequency_hz = np.linspace(1, 100, 1000)
    waves = np.exp(-2j * np.pi * np.outer(frequency_hz, np.arange(500) * period_s))
    gain_db = 20 * np.log10(np.abs(waves @ impulse_response))
    bandwidth_hz = frequency_hz[np.flatnonzero(gain_db < -3.0103)[0]]
    assert 40 < bandwidth_hz < 50
    assert gain_db.max() < 3.0  # and it does not ring
