"""Sequences on the whole testbed: a collector that moves, a metrology loop, and the fringes of two stars."""

import pytest
from sequence_runs import REFERENCE, SINE, WAIT

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import MoveCollector, SequenceControl, Stop
from fitctl.sequences.behaviours.table import loops_of, problems
from fitctl.sequences.instrument import Instrument
from fitctl.sequences.reading import STEPS, make_step

pytestmark = pytest.mark.long

RIG = load_rig(default_rig_path().parent / "fit-testbed.toml")


@pytest.fixture
def testbed(tried):
    """A run on the testbed, its stars and its beam where the rig file has them."""
    as_in_rig = "plant.loops.right.star_offset_sky_arcsec_max=200.0"
    return tried(as_in_rig, rig="fit-testbed.toml")


def pose(link):
    return link._simulation.hexapod.pose()


def stands_still(run):
    """Whether the hexapod stays where it is, once it has had time to stop."""
    for _ in range(4):
        run.link.receive(0.5)
    before = pose(run.link).pose
    for _ in range(4):
        run.link.receive(0.5)
    return pose(run.link).pose == before


def wrong_with(name, /, **keys):
    return problems(make_step(STEPS[name], keys), RIG)


def test_a_motion_of_the_sequence_s_own_moves_the_collector_and_ends_with_the_sequence(testbed):
    way_mm = []
    look = (6.0, 7.0, 8.0, 9.0)
    testbed.link.meddling = [(s, lambda link: way_mm.append(pose(link).pose.y_mm)) for s in look]
    testbed({"step": "standby"}, REFERENCE, SINE, {"step": "wait", "duration_s": 8.0})
    assert testbed.outcomes() == ["done"] * 6
    assert testbed.attempts[4].message == "sine begins"
    assert max(way_mm) - min(way_mm) > 1.0
    assert stands_still(testbed)


def test_a_sequence_that_fails_stops_the_motion_that_it_began(testbed):
    hold = {"step": "hold", "loop": "right", "duration_s": 1.0}
    testbed({"step": "standby"}, REFERENCE, SINE, WAIT, hold)
    assert testbed.outcomes() == ["done"] * 6 + ["failed"]
    assert stands_still(testbed)


def test_a_sequence_that_is_stopped_stops_the_motion_that_it_began(testbed):
    testbed.link.meddling = [(9.0, SequenceControl(action="end"))]
    testbed({"step": "standby"}, REFERENCE, SINE, {"step": "wait", "duration_s": 30.0})
    assert testbed.states[-1] == "stopped"
    assert stands_still(testbed)


def test_stop_stops_the_motion_and_the_sequence(testbed):
    testbed.link.meddling = [(8.0, Stop())]
    testbed({"step": "standby"}, REFERENCE, SINE, {"step": "wait", "duration_s": 30.0})
    assert "SAFE" in testbed.error
    assert stands_still(testbed)


def test_safe_of_a_loop_ends_the_sequence_and_the_motion_that_it_began(testbed):
    assert testbed.link.send(Stop(loop="right")).accepted  # before the sequence
    testbed(REFERENCE, SINE, WAIT, {"step": "standby", "loop": "right"})
    assert testbed.outcomes() == ["done"] * 3 + ["stopped"]
    assert stands_still(testbed)


def test_a_visibility_without_both_stars_fails_at_once(testbed):
    testbed({"step": "standby"}, {"step": "visibility", "duration_s": 60.0})
    assert testbed.error.endswith(
        "visibility needs the stars of left and right; loop right is in STANDBY"
    )
    assert testbed.attempts[-1].ended_s - testbed.attempts[-1].began_s < 1.0


def test_a_step_fails_where_somebody_else_stops_the_collector(testbed):
    testbed.link.meddling = [(8.0, MoveCollector(action="stop"))]
    testbed(REFERENCE, SINE, {"step": "wait", "duration_s": 30.0})
    assert "the collector no longer moves: another person stopped it" in testbed.error


def test_a_step_names_the_loop_whose_safe_stopped_the_collector(testbed):
    testbed.link.meddling = [(8.0, Stop(loop="right"))]
    testbed(
        {"step": "standby", "loop": "left"}, REFERENCE, SINE, {"step": "wait", "duration_s": 30.0}
    )
    assert testbed.outcomes() == ["done"] * 3 + ["failed"]
    expected = "no longer moves: loop right is SAFE: operator, and that stops the collector"
    assert testbed.error.endswith(expected)


def test_a_loop_that_was_safe_before_the_motion_did_not_stop_the_collector(testbed):
    assert testbed.link.send(Stop(loop="right")).accepted
    testbed.link.meddling = [(8.0, MoveCollector(action="stop"))]
    testbed(REFERENCE, SINE, {"step": "wait", "duration_s": 30.0})
    assert "the collector no longer moves: another person stopped it" in testbed.error


def test_off_of_the_last_loop_stops_the_collector_and_the_sequence_goes_on(testbed):
    right = {"loop": "right"}
    testbed({"step": "standby", **right}, REFERENCE, SINE, {"step": "off", **right}, WAIT)
    assert (testbed.outcomes(), testbed.error) == (["done"] * 5, "")
    assert stands_still(testbed)


def test_a_hexapod_that_is_not_referenced_fails_the_step(testbed):
    testbed(SINE)
    assert "reference it first" in testbed.error


def test_a_motion_that_ends_leaves_the_next_one_free_to_begin(testbed):
    stop = {"step": "collector", "action": "stop"}
    drift = {"step": "collector", "action": "start", "kind": "drift"}
    testbed(REFERENCE, SINE, WAIT, stop, drift, WAIT, stop)
    assert testbed.outcomes() == ["done"] * 7


def test_what_is_wrong_with_a_motion_is_one_line_before_anything_moves():
    assert wrong_with("collector", action="start", kind="drift", velocity_mm_s=50.0) == [
        "the motion reaches 50 mm/s; collector.hexapod.velocity_limit_mm_s is 8"
    ]
    slow = {"kind": "sine", "amplitude_mm": 60.0, "frequency_hz": 0.01, "direction_deg": 0.0}
    assert wrong_with("collector", action="start", **slow) == [
        "the motion goes 120 mm from end to end; collector.hexapod.travel.y_mm has 100"
    ]
    assert wrong_with("collector", action="stop", kind="sine") == [
        "kind: only allowed with action start"
    ]
    assert wrong_with("collector", action="start", direction_deg=400.0) == [
        "direction_deg: must be less than or equal to 180 (is 400.0)"
    ]
    assert wrong_with("collector", action="start", kind="file") == [
        'file must name a CSV file where kind is "file"'
    ]
    without = problems(
        make_step(STEPS["collector"], {"action": "stop"}), load_rig(default_rig_path())
    )
    assert without == ["rig fit-mock has no collector that moves"]


def test_every_loop_acquires_the_one_that_holds_the_link_first(testbed):
    testbed(
        {"step": "acquire"},
        {"step": "hold", "loop": "metrology", "duration_s": 5.0},
        {"step": "visibility", "duration_s": 5.0, "least_visibility": 0.5},
        {"step": "off"},
    )
    assert [(one.step, one.loop) for one in testbed.attempts if one.step in {"acquire", "off"}] == [
        ("acquire", "metrology"),
        ("acquire", "right"),
        ("acquire", "left"),
        ("off", "right"),
        ("off", "left"),
        ("off", "metrology"),
    ]
    assert set(testbed.outcomes()) == {"done"}
    beam, fringes = testbed.figures(3), testbed.figures(4)
    assert 0 < beam["rms_az_arcsec"] < beam["limit_arcsec"] == 1.0
    assert 0.5 < fringes["visibility_5_percent"] < fringes["visibility"] < 1.0


OF_BEAMS = {"acquire", "ambient", "beam_scan", "hold", "standby", "off"}


@pytest.mark.parametrize("name", sorted(set(STEPS) - OF_BEAMS))
def test_a_step_that_is_for_stars_refuses_a_metrology_loop_in_one_line(name):
    keys = {
        "controller": {"name": "eq20"},
        "offset": {"offset_az_px": 0.0, "offset_el_px": 0.0},
        "experiment": {"what": "delay"},
        "chirp": {"channel": "fsm_az"},
        "wait": {"duration_s": 1.0},
        "visibility": {"duration_s": 1.0},
        "collector": {"action": "stop"},
        "stars": {"stars": [{"name": "alpha", "az_sky_arcsec": 0.0, "el_sky_arcsec": 0.0}]},
    }.get(name, {})
    found = wrong_with(name, loop="metrology", **keys)
    of_no_loop = {"wait", "visibility", "collector"}
    expected = f"{name} is for a stellar loop; metrology holds a metrology beam"
    assert found == ([] if name in of_no_loop else [expected])


def test_keys_of_a_star_are_refused_for_a_metrology_loop():
    (flux,) = wrong_with("acquire", loop="metrology", star_flux_dn=1000.0)
    assert flux.startswith("star_flux_dn and field_overlap are of a star")
    (limit,) = wrong_with("hold", loop="metrology", duration_s=1.0, rms_limit_px=0.1)
    assert limit.startswith("rms_limit_px is for stars")
    (radius,) = wrong_with("acquire", loop="metrology", search_radius_sky_arcsec=1e4)
    assert "travel_sky_arcsec of loops.metrology.siderostat is 1500" in radius


def test_a_loop_must_be_named_where_the_step_is_for_one():
    assert wrong_with("hold", duration_s=1.0) == [
        "loop is missing: rig fit-testbed has right, metrology, left"
    ]
    assert loops_of(make_step(STEPS["off"], {}), RIG) == ["right", "left", "metrology"]


def test_a_program_s_motion_goes_on_between_its_steps():
    with Instrument(RIG, simulate=True, seed=1) as instrument:
        instrument.collector("reference")
        instrument.collector("start", kind="drift", velocity_mm_s=1.0)
        instrument.wait(2.0)
        assert instrument.telemetry().collector.motion == "drift"
        instrument.collector("stop")
        assert instrument.telemetry().collector.motion == ""
