"""The compiled batch makes the very runs that the simulation makes."""

import math
from itertools import groupby

import numpy as np
import pytest

from benchmarks.learn_online import NIGHTS, outcome
from fitctl.config import ConfigError, StackHysteresis, default_rig_path, load_rig
from fitctl.logging.records import ControllerChange, Event, MetrologyTick
from fitctl.messages.modes import Mode
from fitctl.model.compiled import numba_installed
from fitctl.model.plant_constants import plant_constants
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.laws import NOT_DUE
from fitctl.simulation.batch.learning import Changes, RateChange
from fitctl.simulation.batch.records import DONE, NOT_FOUND, REFUSED_COURSE
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.simulation import Simulation, simulate, simulate_rig
from fitctl.simulation.statistics import motion_start_s

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)"),
]

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


def both(rig, seed, duration_s, record=None):
    """One run of the simulation, tick by tick, and of the batch."""
    simulation = Simulation(rig, seed, history_s=duration_s + 1.0, record=record)
    simulation.acquire()
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
    return simulation, Batch(rig).run(seed, duration_s, keep=True)


def assert_same_run(simulation, batch_run, loop="right", within=1e-9):
    run = batch_run.loops[loop]
    ticks = [tick for tick in simulation.ticks if tick.number > 0 and tick.loop == loop]
    assert len(run.ticks) == len(ticks)
    assert [Mode(mode).name for mode in run.ticks["mode"]] == [tick.mode for tick in ticks]
    seen = np.array([tick.star_visible for tick in ticks])
    assert np.array_equal(run.ticks["star_visible"] == 1, seen)
    for ours, theirs in FIELDS.items():
        expected = np.array([[getattr(tick, name) for name in theirs] for tick in ticks])
        rows = seen if ours == "star_px" else slice(None)
        assert np.all(np.abs(run.ticks[ours] - expected)[rows] < within), ours
    plant = simulation.plants[loop]
    true_px = plant.history_px(0.0, plant.time_s)[:, 0, 0]
    assert np.abs(run.true - true_px).max() < within


@pytest.mark.parametrize("controller", ["eq20", "lqg-ltr", "minimum-variance", "fslq"])
def test_every_design_makes_the_same_run_from_the_search_to_the_held_star(controller):
    simulation, run = both(rig_with(CONTROLLER.format(controller)), 3, 14.0)

    assert_same_run(simulation, run)
    assert simulation.mode_changes[-1].target == "VERNIER"


LINES = (
    "plant.loops.right.lines=["
    "{frequency_hz=6.0, rms_px=0.05, direction_deg=20.0, damping=0.01, drift_hz_per_min=0.0}, "
    "{frequency_hz=48.9, rms_px=0.02, direction_deg=90.0, damping=0.0, drift_hz_per_min=-3.0}]"
)


RATE = "loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}"
PLANT_RATE, LOOP_RATE = f"plant.{RATE}", RATE
TIMELINE = (
    "plant.timeline=["
    "{at_s=1.505, loops={right={air_path={gain_px=0.9, b1_s2=0.1, b2_s=2.5}}}}, "
    "{at_s=2.003, pixel_noise_dn=60.0}, "
    "{at_s=3.0, loops={right={loop_width_fraction=0.3, lines=["
    "{frequency_hz=8.7, rms_px=0.05, direction_deg=20.0, damping=0.0, drift_hz_per_min=3.0}]}}}, "
    "{at_s=4.5, pixel_noise_dn=5.0, loops={right={loop_width_fraction=0.0, lines=[]}}}]"
)


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(
            ["loops.right.flux_range={low=0.3, high=1.6}", "loops.right.other_spots=[]"],
            id="either spot is a star",
        ),
        pytest.param(["plant.loops.right.air_path.gain_px=6.0"], id="star lost and found"),
        pytest.param(
            [
                "loops.right.flux_range={low=0.3, high=1.6}", "loops.right.other_spots=[]",
                "plant.loops.right.air_path.gain_px=6.0",
            ],
            id="either spot is a star, which is lost and found",
        ),
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
        pytest.param(
            [  # the star is at 158 arcsec: seen from 130, and not reached
                "loops.right.siderostat.travel_sky_arcsec=130.0",
                "loops.right.acquisition.search_radius_sky_arcsec=130.0",
            ],
            id="end of travel",
        ),
        pytest.param(["loops.right.target_px={az=35.0, el=5.0}"], id="far from the field's middle"),
        pytest.param(
            [CONTROLLER.format("minimum-variance"), "loops.right.fsm.dac.writes_per_frame=5"],
            id="five writes of the D/A a frame",
        ),
        pytest.param(
            [
                CONTROLLER.format("minimum-variance"), "loops.right.fsm.dac.writes_per_frame=3",
                "plant.loops.right.air_path.gain_px=6.0",
            ],
            id="three writes of the D/A a frame, star lost and found, mirror beyond its range",
        ),
        pytest.param(
            [
                "plant.loops.right.spots=[{name='pointing', offset_px={az=0.0, el=0.0}, "
                "flux_dn=28000.0, diameter_px=1.5}]"
            ],
            id="now and then most light in one pixel",
        ),
        pytest.param(["loops.right.sensor=fit"], id="fit"),
        pytest.param(["camera.electrons_per_dn=1.0"], id="photon noise"),
        pytest.param(
            [
                "loops.right.sensor=fit", "camera.electrons_per_dn=0.5",
                CONTROLLER.format("minimum-variance"),
            ],
            id="fit with photon noise",
        ),
        pytest.param([LINES], id="vibration lines"),
        pytest.param(
            [
                "plant.exposure_instants=5", LINES,
                "loops.right.flux_range={low=0.3, high=1.6}", "loops.right.other_spots=[]",
            ],
            id="smeared by motion",
        ),
        pytest.param(
            [PLANT_RATE, LOOP_RATE, "loops.right.siderostat.rotation_deg=25.0"], id="star that moves"
        ),
        pytest.param(
            [
                PLANT_RATE, "loops.right.siderostat.travel_sky_arcsec=90.0",
                "loops.right.acquisition.search_radius_sky_arcsec=90.0",
            ],
            id="star that leaves",
        ),
        pytest.param(
            ["plant.loops.right.hysteresis.creep_per_decade=0.03", CONTROLLER.format("eq20")],
            id="creep",
        ),
        pytest.param(
            [
                "loops.right.siderostat.axis_gains=[[1.1, 0.05], [-0.1, 0.9]]",
                "loops.right.fsm.axis_gains=[[0.9, 0.1], [0.05, 1.1]]",
                "loops.right.siderostat.rotation_deg=20.0",
                "plant.loops.right.fsm_axis_gains=[[0.85, 0.1], [0.0, 1.2]]",
                LOOP_RATE, PLANT_RATE,
            ],
            id="gains of the axes",
        ),
        pytest.param([TIMELINE, CONTROLLER.format("minimum-variance")], id="timeline"),
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
    ticks = run.loops["right"].ticks
    assert set(ticks["round"][ticks["again"] == 1]) >= {0, 1, 2, 3}


def test_a_lost_star_that_does_not_come_back_in_time_is_simulated():
    run = Batch(rig_with(*AWAY, "loops.right.acquisition.search_again_s=0.5")).run(3, 30.0)

    assert run.ended == NOT_FOUND
    assert run.loops["right"].state["again"] == 1


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
    straight = Batch(rig).result(5, 60.0).loops["right"]

    found = Batch(rig_with(*turned)).result(5, 60.0).loops["right"]

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

    result = Batch(rig).result(5, 25.0).loops["right"]

    for name, value in expected._asdict().items():
        if name != "speed_x":
            assert getattr(result, name) == pytest.approx(value, rel=1e-9, abs=1e-12), name


def test_what_a_batch_does_not_know_is_simulated():
    # Nothing bright enough to be a star: the search ends without one.
    rig = rig_with(
        "loops.right.star_flux_dn=80000.0", "plant.loops.right.star_offset_sky_arcsec_max=0.0"
    )
    run = Batch(rig).run(1, 30.0)

    result = Batch(rig).result(1, 30.0).loops["right"]

    assert run.ended != 0
    assert math.isnan(result.acquired_s)
    assert result.mode_times["STANDBY"] > 1.0


def test_a_rig_with_more_than_fits_is_refused():
    with pytest.raises(BatchRefusalError, match="steps to remember"):
        Batch(rig_with("plant.step_s=0.00005"))


def test_a_rig_with_more_changes_than_fit_is_refused():
    changes = ", ".join(f"{{at_s={second}.0, pixel_noise_dn=20.0}}" for second in range(1, 65))

    with pytest.raises(BatchRefusalError, match="timeline has 64 changes; the batch holds 62"):
        Batch(rig_with(f"plant.timeline=[{changes}]"))


def test_a_spot_in_its_own_stars_window_is_refused_where_the_star_is_fitted():
    ghost = "{name='ghost', offset_px={az=4.0, el=0.0}, flux_dn=4000.0}"

    with pytest.raises(BatchRefusalError, match="spot ghost reaches into its star's window"):
        Batch(rig_with("loops.right.sensor=fit", f"loops.right.other_spots=[{ghost}]"))


def test_a_rig_with_more_lines_than_fit_is_refused():
    line = "{frequency_hz=6.0, rms_px=0.0, direction_deg=0.0, damping=0.0, drift_hz_per_min=0.0}"

    with pytest.raises(BatchRefusalError, match="the batch holds"):
        Batch(rig_with(f"plant.loops.right.lines=[{', '.join([line] * 9)}]"))


@pytest.mark.parametrize(
    "overrides",
    [
        ["interlocks.fsm_edge.action=flatten"],
        ["interlocks.star_lost.action=freeze"],
        ["interlocks.siderostat_rate.high=0.5"],
        ["plant.frame_delay_s=0.07"],  # later than the frame-age row allows
    ],
)
def test_a_rig_whose_interlocks_may_act_is_refused(overrides):
    with pytest.raises(BatchRefusalError, match="may act"):
        Batch(rig_with(*overrides))


# ---------------------------------------------------------------- several loops

TESTBED = default_rig_path().parent / "fit-testbed.toml"
BEAM_FIELDS = {
    "place_m": ("beam_az_m", "beam_el_m"),
    "motor_rad": FIELDS["motor_rad"],
    "setpoint_rad": FIELDS["setpoint_rad"],
}


def rig_of_testbed(*overrides):
    return load_rig(TESTBED, overrides)


def both_of_all(rig, seed, duration_s):
    """One run of the simulation, its collector moving from its start on, and of the batch."""
    samples = []
    simulation = Simulation(
        rig,
        seed,
        history_s=duration_s + 1.0,
        record=lambda record: samples.append(record) if isinstance(record, MetrologyTick) else None,
    )
    simulation.acquire()
    motion_s = motion_start_s(rig)
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
        if simulation.clock.now_s() >= motion_s:
            simulation.move_collector()
            motion_s = math.inf
    return simulation, samples, Batch(rig).run(seed, duration_s, keep=True)


def assert_same_loops(simulation, samples, run):
    for name in simulation.plants:
        assert_same_run(simulation, run, name)
    for name, part in simulation.plant.metrology_loops.items():
        ours, theirs = run.loops[name], [s for s in samples if s.loop == name and s.number > 0]
        assert [Mode(mode).name for mode in ours.ticks["mode"]] == [s.mode for s in theirs]
        for field, names in BEAM_FIELDS.items():
            expected = np.array([[getattr(s, one) for one in names] for s in theirs])
            rows = ~np.isnan(expected)
            assert np.all(np.abs(ours.ticks[field] - expected)[rows] < 1e-9), field
        true_m = part.history_offset_m(0.0, part.time_s)[:, 0]
        assert np.abs(ours.true - true_m).max() < 1e-12


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(["collector.motion.kind=still"], id="still"),
        pytest.param(
            [
                "collector.motion.kind=sine",
                "plant.exposure_instants=2",
                "plant.loops.left.star_rate_sky_arcsec_s={az=8.0, el=5.0}",
                "loops.left.star_rate_sky_arcsec_s={az=8.0, el=5.0}",
            ],
            id="smeared, and one star moves",
        ),
        pytest.param(["collector.motion.kind=drift"], id="drift"),
        pytest.param(["collector.motion.kind=sine"], id="sine"),
        pytest.param(["collector.motion.kind=random"], id="random"),
        pytest.param(
            ["collector.motion.kind=sine", "loops.left.feedforward.gain=0.0"], id="no feedforward"
        ),
        pytest.param(
            [
                "collector.motion.kind=drift",
                "loops.left.feedforward.matrix=[[0.9, 0.2], [-0.1, 1.1]]",
                "loops.left.siderostat.rotation_deg=20.0",
                "loops.metrology.siderostat.rotation_deg=-35.0",
                "loops.left.vernier.controller=minimum-variance",
            ],
            id="turned",
        ),
    ],
)
def test_all_loops_of_the_testbed_make_the_same_run(overrides):
    rig = rig_of_testbed("collector.motion.start_s=13.0", *overrides)

    simulation, samples, run = both_of_all(rig, 1, 19.0)

    assert run.ended == DONE
    assert_same_loops(simulation, samples, run)


def test_a_beam_that_is_pulled_in_again_while_its_star_moves_makes_the_same_run():
    rig = rig_of_testbed(
        "collector.motion.start_s=13.0",
        "collector.motion.kind=still",
        "plant.loops.metrology.air_path.rms_sky_arcsec=80.0",
        "loops.metrology.acquisition.search_again_pause_s=0.2",
        "plant.loops.left.star_rate_sky_arcsec_s={az=8.0, el=5.0}",
        "loops.left.star_rate_sky_arcsec_s={az=8.0, el=5.0}",
    )

    simulation, samples, run = both_of_all(rig, 1, 19.0)

    assert run.ended == DONE
    assert_same_loops(simulation, samples, run)
    modes = [mode for mode, _ in groupby(run.loops["metrology"].ticks["mode"].tolist())]
    assert [int(Mode.LOCKED), int(Mode.COARSE), int(Mode.LOCKED)] == modes[-3:]


@pytest.mark.parametrize(
    ("seed", "has_candidate"),
    [
        pytest.param(18, False, id="on the spiral"),
        pytest.param(8, True, id="before the second look"),
        pytest.param(28, True, id="twice"),
    ],
)
def test_a_search_that_waits_for_its_link_rests_and_goes_on_in_the_same_way(seed, has_candidate):
    rig = rig_of_testbed(
        "collector.motion.kind=still",
        "plant.loops.metrology.air_path.rms_sky_arcsec=100.0",
        "loops.metrology.acquisition.search_again_pause_s=0.2",
        "plant.loops.left.star_offset_sky_arcsec_max=150.0",
    )

    simulation, samples, run = both_of_all(rig, seed, 19.0)

    assert run.ended == DONE
    assert_same_loops(simulation, samples, run)
    ticks = run.loops["left"].ticks
    rests = (ticks["search_rests"] == 1) & (ticks["search_due"] == NOT_DUE)
    assert rests.any()
    assert (rests & (ticks["has_candidate"] == 1)).any() == has_candidate


def test_a_link_that_turns_beyond_the_own_travel_and_back_makes_the_same_run():
    rig = rig_of_testbed(
        "collector.motion.start_s=13.0",
        "collector.motion.kind=sine",
        "collector.motion.frequency_hz=0.2",
        "collector.motion.amplitude_mm=2.4",
        "loops.left.siderostat.travel_sky_arcsec=40.0",
        "loops.left.acquisition.search_radius_sky_arcsec=30.0",
        "plant.loops.left.star_offset_sky_arcsec_max=5.0",
    )

    simulation, samples, run = both_of_all(rig, 1, 19.0)

    assert run.ended == DONE
    assert_same_loops(simulation, samples, run)
    beyond_rad = run.loops["left"].ticks["beyond_rad"]
    assert np.count_nonzero(beyond_rad.any(axis=1)) > 20


def test_a_course_from_a_file_makes_the_same_run(tmp_path):
    path = tmp_path / "course.csv"
    path.write_text("time_s,az_mm,el_mm\n0,0,0\n1,0.5,-0.2\n3,-0.4,0.1\n")
    rig = rig_of_testbed(
        "collector.motion.start_s=13.0",
        "collector.motion.kind=file",
        f"collector.motion.file={path}",
    )

    assert_same_loops(*both_of_all(rig, 2, 18.0))


NEAR = "plant.loops.{}.star_offset_sky_arcsec_max=50.0"


@pytest.mark.parametrize(
    ("seed", "overrides"),
    [
        pytest.param(3, [], id="far from each other"),
        pytest.param(23, [NEAR], id="both on the frame"),
        pytest.param(0, [one.replace("right", "{}") for one in AWAY], id="lost and found"),
    ],
)
def test_two_stars_that_arrive_directly_make_the_same_run(seed, overrides):
    given = [one.format(name) for one in overrides for name in ("right", "left")]
    rig = load_rig(TESTBED.parent / "two-stars.toml", given)

    simulation, samples, run = both_of_all(rig, seed, 16.0)

    assert_same_loops(simulation, samples, run)
    # Candidates that were another loop's star, or went away.
    assert bool(overrides) == any(loop.ticks["rejected"].any() for loop in run.loops.values())


@pytest.mark.parametrize("kind", ["still", "sine"])
def test_a_result_of_all_loops_is_the_simulations(kind):
    rig = rig_of_testbed(f"collector.motion.kind={kind}", "collector.motion.start_s=25.0")
    expected = simulate_rig(rig, 4, 30.0)

    result = Batch(rig).result(4, 30.0)

    assert result.visibility == pytest.approx(expected.visibility, rel=1e-9)
    assert list(result.loops) == list(expected.loops)
    for name, loop in expected.loops.items():
        for field, value in loop._asdict().items():
            if field != "speed_x":
                ours = getattr(result.loops[name], field)
                assert ours == pytest.approx(value, rel=1e-9, abs=1e-12), (name, field)


def test_a_course_that_the_hexapod_refuses_is_bad_input():
    rig = rig_of_testbed("collector.motion.amplitude_mm=30.0", "collector.motion.kind=sine",
                       "collector.motion.start_s=2.0", "collector.motion.frequency_hz=0.001",
                       "collector.hexapod.travel.x_mm=[-20.0,50.0]",
                       "collector.hexapod.travel.y_mm=[-20.0,50.0]")  # fmt: skip

    assert Batch(rig).run(1, 4.0).ended == REFUSED_COURSE
    with pytest.raises(ConfigError, match=r"collector\.motion: .* within -20 and 50"):
        Batch(rig).result(1, 4.0)


def test_a_feedforward_that_the_batch_does_not_model_is_refused():
    with pytest.raises(BatchRefusalError, match="encoders\\+backlash"):
        Batch(rig_of_testbed("loops.left.feedforward.signal=encoders+backlash"))


def test_servos_of_different_rates_are_refused():
    with pytest.raises(BatchRefusalError, match="rates of its servos differ"):
        Batch(rig_of_testbed("loops.left.siderostat.servo.rate_hz=1000.0"))


@pytest.fixture
def learns_at_once(monkeypatch):
    """A learner that reports after half a minute, and a loop that goes back seconds after a change."""
    monkeypatch.setattr("fitctl.learn.learner.FIRST_S", 25.0)
    monkeypatch.setattr("fitctl.learn.learner.EVERY_S", 10.0)
    monkeypatch.setattr("fitctl.loop.comparison.WATCHES", ((2.0, 0.1, 1.1),))


SIX_HZ = (
    "plant.loops.right.lines=["
    "{frequency_hz=6.0, rms_px=0.07, direction_deg=45.0, damping=0.005, drift_hz_per_min=0.0}]"
)


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param([CONTROLLER.format("minimum-variance")], id="knows recent frames"),
        pytest.param([CONTROLLER.format("eq20")], id="the one before begins from rest"),
        pytest.param(
            [
                CONTROLLER.format("minimum-variance"),
                "loops.right.fsm.dac.writes_per_frame=5",
            ],
            id="five writes of the D/A a frame",
        ),
        pytest.param(
            [CONTROLLER.format("minimum-variance"), PLANT_RATE, LOOP_RATE],
            id="a star that moves",
        ),
    ],
)
def test_a_loop_that_learns_changes_its_design_and_goes_back_at_the_same_ticks(
    overrides, learns_at_once
):
    rig = rig_with("loops.right.learn=on", SIX_HZ, *overrides)
    changes = []
    simulation, run = both(
        rig,
        3,
        60.0,
        lambda made: changes.append(made) if isinstance(made, ControllerChange) else None,
    )

    assert [change.target for change in changes] == ["learnt", changes[0].source]
    assert [change.design.title for change in run.changes.designs] == [
        one.target for one in changes
    ]
    assert [change.time_s for change in run.changes.designs] == pytest.approx(
        [one.time_s for one in changes], abs=1e-9
    )
    assert_same_run(simulation, run, within=1e-8)  # rounding adds up in a minute


def test_a_loop_that_wants_another_frame_rate_has_it_at_the_same_frames(learns_at_once):
    rig = rig_with("loops.right.learn=on", SIX_HZ, CONTROLLER.format("minimum-variance"))
    events = []

    simulation, run = both(
        rig, 3, 60.0, lambda made: events.append(made) if isinstance(made, Event) else None
    )

    shown = [event.message for event in events if event.source == "camera"]
    assert shown == ["runs at 47.5 Hz for 12 s", "runs at 50 Hz again"]
    assert [rate.period_s for rate in run.changes.rates] == [1 / 47.5, 1 / 50.0]
    assert_same_run(simulation, run, within=1e-8)


def test_a_line_that_is_known_to_be_an_alias_is_left_alone():
    """On frames, 48.9 Hz looks like 1.1 Hz, which the fixed design removes."""
    night = next(one for one in NIGHTS if one.name == "48.9 Hz, 0.05 px")
    made = outcome(night, 0)

    assert made.learnt_px < 0.9 * made.fixed_px
    assert made.ways_back == 0


def test_a_moving_collector_whose_camera_changes_its_rate_is_simulated():
    rig = rig_of_testbed("collector.motion.kind=sine", "collector.motion.start_s=3.0")
    changes = Changes((), (RateChange(100, 1 / 48),))

    assert Batch(rig).run(1, 5.0, changes=changes).ended == REFUSED_COURSE


def test_each_loop_of_the_testbed_learns_at_the_same_ticks(learns_at_once):
    rig = rig_of_testbed(
        *(
            setting
            for loop in ("right", "left")
            for setting in (
                f"loops.{loop}.learn=on",
                f"loops.{loop}.vernier.controller=minimum-variance",
                f"loops.{loop}.fastest_line_hz=30.0",  # another frame rate would not fit the moving collector
                SIX_HZ.replace("loops.right", f"loops.{loop}"),
            )
        )
    )

    simulation, _, run = both_of_all(rig, 3, 42.0)

    learnt = [change.loop for change in run.changes.designs if change.design.learnt]
    assert sorted(learnt) == ["left", "right"]
    for loop in learnt:
        assert_same_run(simulation, run, loop, within=1e-8)


def test_a_loop_that_learns_has_the_result_of_its_simulation(learns_at_once):
    rig = rig_with("loops.right.learn=on", SIX_HZ, CONTROLLER.format("minimum-variance"))

    ours, theirs = Batch(rig).result(3, 50.0), simulate_rig(rig, 3, 50.0)

    for axis in ("az", "el"):
        left_px, expected_px = (one.loops["right"].rms_px[axis] for one in (ours, theirs))
        assert left_px == pytest.approx(expected_px, abs=1e-6)
