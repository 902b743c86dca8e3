"""The compiled batch makes the very runs that the simulation makes."""

import math

import numpy as np
import pytest

from fitctl.config import StackHysteresis, default_rig_path, load_rig
from fitctl.messages.modes import Mode
from fitctl.model.compiled import numba_installed
from fitctl.model.plant_constants import plant_constants
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.records import NOT_FOUND
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.simulation import Simulation, simulate

pytestmark = pytest.mark.skipif(
    not numba_installed(), reason="numba is not installed (extra `fast`)"
)

CONTROLLER = "loops.right.vernier.controller={}"
FIELDS = {
    "star_px": ("star_az_px", "star_el_px"),
    "command_px": ("target_az_px", "target_el_px"),
    "stack_v": ("stack1_v", "stack2_v", "stack3_v"),
    "mirror_command_rad": ("fsm_az_rad", "fsm_el_rad"),
    "motor_rad": ("siderostat_az_rad", "siderostat_el_rad"),
    "setpoint_rad": ("siderostat_setpoint_az_rad", "siderostat_setpoint_el_rad"),
}


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def both(rig, seed, duration_s):
    """One run of the simulation, tick by tick, and of the batch."""
    simulation = Simulation(rig, seed, history_s=duration_s + 1.0)
    simulation.acquire()
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
    return simulation, Batch(rig).run(seed, duration_s, keep=True)


def assert_same_run(simulation, run):
    ticks = [tick for tick in simulation.ticks if tick.number > 0]
    assert len(run.ticks) == len(ticks)
    assert [Mode(mode).name for mode in run.ticks["mode"]] == [tick.mode for tick in ticks]
    seen = np.array([tick.star_visible for tick in ticks])
    assert np.array_equal(run.ticks["star_visible"] == 1, seen)
    for ours, theirs in FIELDS.items():
        expected = np.array([[getattr(tick, name) for name in theirs] for tick in ticks])
        rows = seen if ours == "star_px" else slice(None)
        assert np.all(np.abs(run.ticks[ours] - expected)[rows] < 1e-9), ours
    plant = simulation.plants["right"]
    true_px = plant.history_px(0.0, plant.time_s)[:, 0, 0]
    assert np.abs(run.true_px - true_px).max() < 1e-9


@pytest.mark.parametrize("controller", ["eq20", "lqg-ltr", "minimum-variance", "fslq"])
def test_every_design_makes_the_same_run_from_the_search_to_the_held_star(controller):
    simulation, run = both(rig_with(CONTROLLER.format(controller)), 3, 14.0)

    assert_same_run(simulation, run)
    assert simulation.mode_changes[-1].target == "VERNIER"


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(
            ["loops.right.flux_range={low=0.3, high=1.6}", "loops.right.other_spots=[]"],
            id="either spot is a star",
        ),
        pytest.param(["plant.loops.right.air_path.gain_px=6.0"], id="star lost and found"),
        pytest.param(["loops.right.acquisition.detection_sigma=4.0"], id="noise is looked at"),
        pytest.param(
            ["camera.frame_delay_s=0.055", CONTROLLER.format("minimum-variance")],
            id="more than two frames of delay",
        ),
        pytest.param(
            [
                "camera.frame_rate_hz=500.0", "camera.exposure_s=0.001",
                "camera.frame_delay_s=0.0035", "plant.step_s=0.00025",
            ],
            id="flight rate",
        ),
        pytest.param(["loops.right.siderostat.travel_sky_arcsec=60.0"], id="end of travel"),
        pytest.param(["loops.right.target_px={az=35.0, el=5.0}"], id="far from the field's middle"),
        pytest.param(
            [
                "plant.loops.right.spots=[{name='pointing', offset_px={az=0.0, el=0.0}, "
                "flux_dn=28000.0, diameter_px=1.5}]"
            ],
            id="now and then most light in one pixel",
        ),
    ],
)  # fmt: skip
def test_unusual_rigs_make_the_same_run(overrides):
    simulation, run = both(rig_with(*overrides), 7, 6.0)

    assert_same_run(simulation, run)


# Air that carries the star out of the field, and back within a minute.
AWAY = (
    "plant.loops.right.air_path.gain_px=40.0",
    "plant.loops.right.star_offset_sky_arcsec_max=5.0",
    "loops.right.acquisition.search_again_pause_s=0.2",
    "loops.right.acquisition.search_radius_sky_arcsec=40.0",
)


def test_a_star_that_is_lost_for_long_makes_the_same_run_round_by_round():
    simulation, run = both(rig_with(*AWAY), 3, 30.0)

    assert_same_run(simulation, run)
    assert set(run.ticks["round"][run.ticks["again"] == 1]) >= {0, 1, 2, 3}


def test_a_lost_star_that_does_not_come_back_in_time_is_simulated():
    run = Batch(rig_with(*AWAY, "loops.right.acquisition.search_again_s=0.5")).run(3, 30.0)

    assert run.ended == NOT_FOUND
    assert run.state["again"] == 1


TURNED = ("loops.right.siderostat.rotation_deg=-50.0", "loops.right.fsm.rotation_deg=160.0")


@pytest.mark.parametrize("controller", ["eq20", "minimum-variance"])
def test_turned_stages_make_the_same_run(controller):
    simulation, run = both(rig_with(CONTROLLER.format(controller), *TURNED), 3, 14.0)

    assert_same_run(simulation, run)
    assert simulation.mode_changes[-1].target == "VERNIER"


@pytest.mark.parametrize(
    "turned",
    [
        ["loops.right.siderostat.rotation_deg=30.0", "loops.right.fsm.rotation_deg=30.0"],
        TURNED,
    ],
    ids=["the camera is turned", "each stage is turned"],
)
def test_the_star_is_held_as_well_by_stages_that_are_turned(rig, turned):
    """The air is the same; encoder counts and hysteresis come in other moments."""
    straight = Batch(rig).result(5, 60.0)

    found = Batch(rig_with(*turned)).result(5, 60.0)

    for axis, straight_px in straight.rms_px.items():
        assert found.rms_px[axis] == pytest.approx(straight_px, rel=0.15), axis


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("controller", ["eq20", "minimum-variance"])
def test_runs_are_the_same_whether_or_not_the_hysteresis_is_known(controller, known):
    rig = rig_with(CONTROLLER.format(controller))
    loop, plant = rig.loops["right"], plant_constants(rig, "right", np.zeros((1, 2)))
    identified = StackHysteresis(
        half_widths_v=plant.play_half_v.tolist(),
        gains_m_per_v=[(scale * plant.play_gain_m_per_v).tolist() for scale in (0.97, 1.0, 1.02)],
    )
    fsm = loop.fsm.model_copy(update={"hysteresis": identified if known else None})
    rig = rig.model_copy(update={"loops": {"right": loop.model_copy(update={"fsm": fsm})}})

    simulation, run = both(rig, 3, 14.0)

    assert_same_run(simulation, run)
    assert simulation.mode_changes[-1].target == "VERNIER"


def test_a_result_is_the_simulations_result(rig):
    expected = simulate(rig, 5, 25.0)["right"]

    result = Batch(rig).result(5, 25.0)

    for name, value in expected._asdict().items():
        if name != "speed_x":
            assert getattr(result, name) == pytest.approx(value, rel=1e-9, abs=1e-12), name


def test_what_a_batch_does_not_know_is_simulated():
    # Nothing bright enough to be a star: the search ends without one.
    rig = rig_with(
        "loops.right.star_flux_dn=80000.0", "plant.loops.right.star_offset_sky_arcsec_max=0.0"
    )
    run = Batch(rig).run(1, 30.0)

    result = Batch(rig).result(1, 30.0)

    assert run.ended != 0
    assert math.isnan(result.acquired_s)
    assert result.mode_times["STANDBY"] > 1.0


def test_a_rig_with_more_than_fits_is_refused():
    with pytest.raises(BatchRefusalError, match="steps to remember"):
        Batch(rig_with("plant.step_s=0.00005"))


@pytest.mark.parametrize(
    "overrides",
    [
        ["interlocks.fsm_edge.action=flatten"],
        ["interlocks.star_lost.action=hold"],
        ["interlocks.siderostat_rate.high=0.5"],
        ["interlocks.piezo_limit.stale_s=0.5"],
        ["plant.frame_delay_s=0.07"],  # later than the frame-age row allows
    ],
)
def test_a_rig_whose_interlocks_may_act_is_refused(overrides):
    with pytest.raises(BatchRefusalError, match="may act"):
        Batch(rig_with(*overrides))
