"""Three loops and a collector: what one does to the other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.model.hexapod_motion import at_rest
from fitctl.model.metrology import part as metrology_part
from fitctl.model.metrology.geometry import array_lever, star_turn
from fitctl.model.metrology.photodiodes import diode_volts
from fitctl.model.plant import Plant

TESTBED = default_rig_path().parent / "fit-testbed.toml"
STILL = [
    "plant.loops.right.air_path.gain_px=0.0",
    "plant.loops.left.air_path.gain_px=0.0",
    "plant.loops.metrology.air_path.rms_sky_arcsec=0.0",
    "plant.loops.metrology.beam_offset_sky_arcsec_max=0.0",
]
SKY_PX_PER_RAD = 4.0 * 0.457 / 24e-6


def rig_with(*overrides):
    return load_rig(TESTBED, [*STILL, *overrides])


def still_plant(*overrides, seeds=(0,), **kwargs):
    return Plant(rig_with(*overrides), seeds, star_offset_px=np.zeros((len(seeds), 2)), **kwargs)


def shifted(plant, before_px, loop):
    """How far a loop's star moved, in px, since `before_px`, now."""
    return (plant.stellar_loops[loop].spots_px(plant.time_s)[0, 0] - before_px).tolist()


def standing_px(plant, loop):
    return plant.stellar_loops[loop].spots_px(plant.time_s)[0, 0].copy()


def turn(plant, loop, velocity_rad_s, for_s):
    plant.loops[loop].inputs.velocity_rad_s[0] = velocity_rad_s
    plant.advance(plant.time_s + for_s)
    plant.loops[loop].inputs.velocity_rad_s[0] = 0.0
    plant.advance(plant.time_s + 0.1)


# ---------------------------------------------------------------- the coupling


def test_a_millimetre_of_the_collector_is_a_millimetre_on_the_array_and_nothing_to_a_star():
    plant = still_plant()
    plant.advance(0.1)
    before = {loop: standing_px(plant, loop) for loop in ("left", "right")}
    plant.collector.follow(at_rest([0.0, 1.0, -0.5, 0.0, 0.0, 0.0]))
    plant.advance(0.2)
    beam_m = plant.metrology_loops["metrology"].offset_m(0.2)[0]
    assert beam_m == pytest.approx([-1e-3, 0.5e-3])
    for loop, px in before.items():
        assert shifted(plant, px, loop) == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_siderostat_that_follows_the_collector_turns_the_left_star_alone():
    """100 urad, which follow 1 mm over 10 m, are 7.6 px: more than the mirror's reach."""
    plant = still_plant("plant.loops.metrology.backlash_sky_arcsec=0.0")
    metrology = plant.metrology_loops["metrology"]
    plant.advance(0.1)
    before = {loop: standing_px(plant, loop) for loop in ("left", "right")}
    motor_rad = 1e-4 / metrology.constants.sky_rad_per_motor_rad
    turn(plant, "metrology", [motor_rad, 0.0], 1.0)
    assert metrology.offset_m(plant.time_s)[0] == pytest.approx([1e-3, 0.0], rel=1e-3)
    assert shifted(plant, before["left"], "left") == pytest.approx([7.617, 0.0], abs=0.01)
    assert shifted(plant, before["right"], "right") == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_collector_siderostat_can_turn_the_left_star_back():
    plant = still_plant(
        "plant.loops.metrology.backlash_sky_arcsec=0.0", "plant.loops.left.backlash_sky_arcsec=0.0"
    )
    plant.advance(0.1)
    before_px = standing_px(plant, "left")
    turn(plant, "metrology", [2.0, -1.0], 1.0)
    turn(plant, "left", [-2.0, 1.0], 1.0)
    assert shifted(plant, before_px, "left") == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("loop", ["right", "metrology", "left"])
def test_every_siderostat_has_backlash(loop):
    plant = still_plant()
    width_rad = 1.0 / ARCSEC_PER_RAD / rig_with().loops[loop].siderostat.sky_rad_per_motor_rad
    turn(plant, loop, [1.0, 0.0], 1.0)
    part = plant.loops[loop]
    beam = part.state.beam_motor_rad[0].copy()
    turn(plant, loop, [-0.9 * width_rad, 0.0], 1.0)
    assert part.state.beam_motor_rad[0] == pytest.approx(beam), "within the play nothing turns"
    turn(plant, loop, [-0.9 * width_rad, 0.0], 1.0)
    assert part.state.beam_motor_rad[0, 0] == pytest.approx(beam[0] - 0.8 * width_rad, rel=1e-3)


def test_a_rotation_of_the_bench_turns_the_left_star_and_moves_the_array():
    rig = rig_with()
    plant = still_plant()
    plant.advance(0.1)
    before = {loop: standing_px(plant, loop) for loop in ("left", "right")}
    psi_deg = np.array([2e-3, -1e-3, 3e-3])
    plant.collector.follow(at_rest([0.0, 0.0, 0.0, *psi_deg]))
    plant.advance(0.2)
    psi = np.radians(psi_deg)
    geometry = rig.collector.geometry
    star_px = SKY_PX_PER_RAD * star_turn(geometry) @ psi
    assert shifted(plant, before["left"], "left") == pytest.approx(star_px.tolist())
    assert shifted(plant, before["right"], "right") == pytest.approx([0.0, 0.0], abs=1e-12)
    beam_m = plant.metrology_loops["metrology"].offset_m(0.2)[0]
    assert beam_m == pytest.approx(-array_lever(geometry) @ psi)


def test_the_links_air_moves_the_beam_and_no_star():
    still = still_plant()
    windy = still_plant("plant.loops.metrology.air_path.rms_sky_arcsec=0.5")
    for plant in (still, windy):
        plant.advance(60.0)
    metrology = windy.metrology_loops["metrology"]
    beam_arcsec = metrology.history_offset_m(0.0, 60.0)[:, 0] / 10.0 * ARCSEC_PER_RAD
    # Thirty independent stretches of 2 b2 = 5 s or so would scatter by a fifth.
    assert np.sqrt(np.mean(beam_arcsec**2)) == pytest.approx(0.5, rel=0.3)
    for loop in ("left", "right"):
        assert np.array_equal(
            windy.stellar_loops[loop].history_px(50.0, 60.0),
            still.stellar_loops[loop].history_px(50.0, 60.0),
        )


def test_the_seed_places_the_beam_over_its_disc():
    plant = still_plant(
        "plant.loops.metrology.beam_offset_sky_arcsec_max=900.0", seeds=range(300), history_s=1.0
    )
    metrology = plant.metrology_loops["metrology"]
    distance_m = np.linalg.norm(metrology.offset_m(0.001), axis=1)
    radius_m = 900.0 / ARCSEC_PER_RAD * 10.0
    assert distance_m.max() <= radius_m
    assert np.mean(distance_m < radius_m * np.sqrt(0.5)) == pytest.approx(0.5, abs=0.12)


# ---------------------------------------------------------------- one plant


def test_the_right_loop_is_the_one_of_a_rig_that_has_no_other():
    whole = load_rig(TESTBED)
    parts = {
        section: getattr(whole, section).model_copy(
            update={"loops": {"right": getattr(whole, section).loops["right"]}}
        )
        for section in ("plant", "mocks")
    }
    alone = whole.model_copy(
        update={"loops": {"right": whole.loops["right"]}, "collector": None, "fringes": None}
        | parts
    )
    plants = [Plant(rig, [5]) for rig in (whole, alone)]
    for plant in plants:
        plant.stellar_loops["right"].inputs.velocity_rad_s[:] = [3.0, -2.0]
        plant.advance(1.0)
    one, other = (plant.stellar_loops["right"].history_px(0.0, 1.0) for plant in plants)
    assert np.array_equal(one, other)


@pytest.mark.long
@settings(max_examples=15)
@given(cuts=st.lists(st.integers(1, 1500), max_size=12))
def test_the_motion_does_not_depend_on_how_the_time_is_cut(cuts):
    course = _Circling()
    plants = [Plant(load_rig(TESTBED), [7]) for _ in range(2)]
    for plant in plants:
        plant.collector.follow(course)
        for part in plant.loops.values():
            part.inputs.velocity_rad_s[:] = [3.0, -2.0]
    for step in sorted(cuts):
        plants[1].advance(step * plants[1].step_s)
    for plant in plants:
        plant.advance(0.75)
    whole, cut = (
        (
            plant.stellar_loops["left"].history_px(0.0, 0.75),
            plant.metrology_loops["metrology"].history_offset_m(0.0, 0.75),
        )
        for plant in plants
    )
    assert cut[0] == pytest.approx(whole[0], rel=0, abs=1e-9)  # px, of hundreds
    assert cut[1] == pytest.approx(whole[1], rel=0, abs=1e-12)


class _Circling:
    """A course that never stands still."""

    def pose_at(self, time_s):
        phase = 2 * np.pi * 0.5 * np.asarray(time_s)
        zero = np.zeros_like(phase)
        return np.stack(
            [zero, np.sin(phase), np.cos(phase), 0.01 * np.sin(phase), zero, zero], axis=-1
        )


def test_a_new_course_begins_where_the_plant_is():
    plant = still_plant()
    plant.advance(0.1005)
    plant.collector.follow(at_rest([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    plant.advance(0.2)
    beam_m = plant.metrology_loops["metrology"].history_offset_m(0.0, 0.2)[:, 0, 0]
    assert beam_m[200] == pytest.approx(0.0, abs=1e-12)  # at 0.1005 s
    assert beam_m[201] == pytest.approx(-1e-3)


def test_a_run_does_not_depend_on_the_runs_beside_it():
    together, alone = Plant(load_rig(TESTBED), [3, 4, 5]), Plant(load_rig(TESTBED), [4])
    for plant in (together, alone):
        for part in plant.loops.values():
            part.inputs.velocity_rad_s[:] = [3.0, -2.0]
        plant.advance(0.5)
    for name in ("left", "right"):
        assert together.stellar_loops[name].spots_px(0.5)[1] == pytest.approx(
            alone.stellar_loops[name].spots_px(0.5)[0], abs=1e-9
        )
    assert together.metrology_loops["metrology"].offset_m(0.5)[1] == pytest.approx(
        alone.metrology_loops["metrology"].offset_m(0.5)[0], abs=1e-12
    )


def test_without_numba_the_beam_is_the_same(monkeypatch):
    compiled = Plant(load_rig(TESTBED), [3, 4])
    monkeypatch.setattr(metrology_part, "compiled", lambda function: function)
    monkeypatch.setattr(metrology_part, "numba_installed", lambda: False)
    plain = Plant(load_rig(TESTBED), [3, 4])
    for plant in (compiled, plain):
        plant.metrology_loops["metrology"].inputs.velocity_rad_s[:] = [3.0, -2.0]
        plant.advance(0.3)
    one, other = (
        p.metrology_loops["metrology"].history_offset_m(0.0, 0.3) for p in (compiled, plain)
    )
    assert one == pytest.approx(other, rel=0, abs=1e-13)


# ---------------------------------------------------------------- photodiodes


@pytest.mark.long
@given(az_m=st.floats(-0.03, 0.03), el_m=st.floats(-0.03, 0.03), laser=st.sampled_from([1.0, 0.3]))
def test_the_ratio_of_two_photodiodes_is_exponential_in_the_beams_place(az_m, el_m, laser):
    sensor = load_rig(TESTBED).plant.loops["metrology"].sensor
    volts = diode_volts(sensor, [az_m, el_m], laser) - np.array(sensor.ambient_v)
    slope = 8 * sensor.diode_offset_m / sensor.beam_radius_m**2
    # Ambient light is subtracted from a photodiode that may have a thousandth of it.
    assert np.log(volts[0] / volts[1]) == pytest.approx(slope * az_m, abs=1e-6)
    assert np.log(volts[2] / volts[3]) == pytest.approx(slope * el_m, abs=1e-6)


def test_on_the_centre_each_photodiode_gives_what_the_rig_file_says():
    sensor = load_rig(TESTBED).plant.loops["metrology"].sensor
    above_ambient = diode_volts(sensor, [0.0, 0.0]) - np.array(sensor.ambient_v)
    assert above_ambient == pytest.approx([5.0] * 4)


def test_without_the_laser_only_ambient_light_is_left():
    plant = still_plant()
    metrology = plant.metrology_loops["metrology"]
    metrology.inputs.laser[:] = 0.0
    assert metrology.diode_volts(0.1)[0] == pytest.approx(metrology.sensor.ambient_v)
