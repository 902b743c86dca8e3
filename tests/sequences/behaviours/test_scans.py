"""Steps that record the data of the link's identifications, and what `fitctl identify` makes of their logs."""

import tomllib
from itertools import pairwise

import numpy as np
import pytest
from sequence_runs import REFERENCE, lose

from fitctl.cli import main
from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.run import run_info
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.identify.link.step_record import gather_step
from fitctl.logging.records import MetrologyTick, SequenceAttempt, Tick
from fitctl.logging.writer import LogWriter
from fitctl.messages.commands import Jog, MoveCollector, Stop
from fitctl.model.optics import rotation
from fitctl.sequences.behaviours.scans import beam_course
from fitctl.sequences.behaviours.table import problems
from fitctl.sequences.reading import STEPS, make_step
from fitctl.sequences.steps import BeamScan

pytestmark = pytest.mark.long

RIGS = default_rig_path().parent
RIG = load_rig(RIGS / "fit-testbed.toml")
NEAR = (
    "plant.loops.right.star_offset_sky_arcsec_max=20.0",
    "plant.loops.left.star_offset_sky_arcsec_max=20.0",
    "plant.loops.metrology.beam_offset_sky_arcsec_max=20.0",
)
SCAN = {"step": "collector_scan", "loop": "left", "cycles": 3}
WALL_S = 1_795_000_000.0


@pytest.fixture
def testbed(tried, tmp_path):
    """Make a run on the testbed, which records what a log has of it; `run.log()` writes the log."""

    def make(*overrides, seed=1):
        run = tried(*NEAR, *overrides, rig="fit-testbed.toml", seed=seed)
        simulation, kept = run.link._simulation, []
        add = simulation._on_record

        def record(one):
            if isinstance(one, Tick | MetrologyTick | SequenceAttempt):
                kept.append(one)
            add(one)

        def log():
            path = tmp_path / "run.mcap"
            with LogWriter(path, run.rig.logging) as writer:
                writer.write(run_info(run.rig, "", 0.0, designs={}), WALL_S)
                for one in kept:
                    writer.write(one, WALL_S + one.time_s)
            return path

        simulation._on_record, run.records, run.log = record, kept, log
        return run

    return make


def wrong_with(name, rig=RIG, **keys):
    return problems(make_step(STEPS[name], keys), rig)


def test_the_feedforward_is_found_from_a_scan_of_the_collector(
    testbed, tmp_path, monkeypatch, capsys
):
    turned = (
        "loops.metrology.siderostat.rotation_deg=2.0",
        "loops.left.feedforward.matrix=[[1.02, 0.0], [0.0, 0.98]]",
    )
    run = testbed(*turned)
    run(REFERENCE, {"step": "acquire"}, {"step": "wait", "duration_s": 5.0}, SCAN)
    assert run.error == ""
    monkeypatch.chdir(tmp_path)
    sets = [part for each in (*NEAR, *turned) for part in ("--set", each)]
    with pytest.raises(SystemExit) as end:
        main(
            [
                *("identify", "feedforward", "--rig", str(RIGS / "fit-testbed.toml"), *sets),
                *("--loop", "left", "--log", str(run.log())),
            ]
        )
    assert not end.value.code
    fragment = tomllib.loads((tmp_path / "fit-testbed-left-feedforward.toml").read_text())
    matrix = np.array(fragment["loops"]["left"]["feedforward"]["matrix"])
    assert matrix == pytest.approx(rotation(2.0), abs=0.012)
    assert (tmp_path / "fit-testbed-left-feedforward.png").exists()
    assert "of the link's beam" in capsys.readouterr().out


def test_the_collector_ends_a_scan_where_it_began_and_stands_still(testbed):
    run = testbed()
    run(REFERENCE, {"step": "acquire"}, {**SCAN, "cycles": 1})
    assert run.outcomes()[-1] == "done"
    pose = run.link._simulation.hexapod.pose()
    assert not pose.moving
    assert abs(pose.pose.y_mm) < 1.0
    assert abs(pose.pose.z_mm) < 1.0


def test_a_scan_fails_where_somebody_stops_the_collector(testbed):
    run = testbed()
    begun = []

    def stop_once(link):
        begun.append(link)
        link._simulation.command(MoveCollector(action="stop"))

    run.link.meddling = [(30.0, stop_once)]
    run(REFERENCE, {"step": "acquire"}, {**SCAN, "cycles": 10})
    assert begun
    assert "the collector no longer moves: another person stopped it" in run.error


def test_a_scan_names_the_loop_whose_safe_stopped_the_collector(testbed):
    run = testbed()
    run.link.meddling = [(30.0, Stop(loop="right"))]
    metrology, left = ({"step": "acquire", "loop": name} for name in ("metrology", "left"))
    run(REFERENCE, metrology, left, {**SCAN, "cycles": 10})
    expected = "no longer moves: loop right is SAFE: operator, and that stops the collector"
    assert run.error.endswith(expected)


def test_a_scan_whose_answer_is_lost_leaves_no_collector_moving(testbed):
    def lose_the_next(link):
        assert link.receive(1.0).collector.motion
        lose(link, lambda _: True)

    run = testbed()
    run.link.meddling = [(30.0, lose_the_next)]
    with pytest.raises(ConnectionError):
        run(REFERENCE, {"step": "acquire"}, {**SCAN, "cycles": 10})
    assert not run.link.receive(1.0).collector.motion


def test_jogs_use_at_most_half_of_the_commands_that_one_person_may_send(testbed):
    run, jogged_s = testbed("camera.frame_rate_hz=100.0", "camera.exposure_s=0.005"), []
    send = run.link.send

    def sends(command):
        if isinstance(command, Jog):
            jogged_s.append(run.link.now_s())
        return send(command)

    run.link.send = sends
    quick = {"span_sky_arcsec": 60.0, "slow_sky_arcsec_s": 40.0, "cycles": 1}
    run(
        {"step": "standby", "loop": "metrology"},
        {"step": "beam_scan", "loop": "metrology", **quick},
    )
    assert run.outcomes() == ["done", "done"]
    assert np.diff(jogged_s).min() >= 2 / run.rig.service.commands_per_s - 1e-9


def test_photodiodes_and_link_delay_are_found_from_a_scan_of_the_beam(testbed):
    run = testbed(
        "plant.loops.metrology.sensor.beam_radius_m=0.026",
        "plant.loops.metrology.sensor.on_axis_v=4.7",
    )
    beam_scan = {"step": "beam_scan", "loop": "metrology", "cycles": 1}
    run({"step": "acquire", "loop": "metrology"}, beam_scan)
    assert run.error == ""
    path = run.log()
    scale = EXPERIMENTS["photodiodes"].from_log(run.rig, "metrology", path)
    assert abs(scale.found.beam_radius_mm - 26.0) < 4 * scale.sd.beam_radius_mm
    assert abs(scale.found.on_axis_v - 4.7) < 4 * scale.sd.on_axis_v
    delay = EXPERIMENTS["link_delay"].from_log(run.rig, "metrology", path)
    assert abs(delay.delay_s - 0.025) < 4 * delay.delay_sd_s
    assert delay.delay_sd_s < 4e-4
    assert delay.found.play_az_arcsec == pytest.approx(1.0, abs=0.3)


def test_the_beam_comes_back_to_where_it_was_held(testbed):
    run = testbed()
    run(
        {"step": "acquire", "loop": "metrology"},
        {
            "step": "beam_scan", "loop": "metrology", "cycles": 1, "span_sky_arcsec": 60.0,
            "slow_sky_arcsec_s": 40.0,
        },
    )  # fmt: skip
    assert run.outcomes() == ["done", "done"]
    jogs = [one for one in run.link.commands if isinstance(one, Jog)]
    for total in (sum(jog.az_sky_arcsec for jog in jogs), sum(jog.el_sky_arcsec for jog in jogs)):
        assert total == pytest.approx(0.0, abs=1e-6)
    assert max(abs(jog.az_sky_arcsec) for jog in jogs) < 30.0


def test_the_ambient_light_is_found_while_the_laser_is_blocked(testbed):
    run = testbed()
    run.link._simulation.plant.metrology_loops["metrology"].inputs.laser[:] = 0.0
    run({"step": "standby", "loop": "metrology"}, {"step": "ambient", "loop": "metrology"})
    assert run.error == ""
    found = EXPERIMENTS["ambient"].from_log(run.rig, "metrology", run.log())
    truth = run.rig.plant.loops["metrology"].sensor.ambient_v
    assert np.all(np.abs(found.ambient_v - truth) < 4 * found.sd_v + 2e-4)  # and the A/D's steps
    assert found.sd_v.max() < 2e-4


def test_the_course_of_the_beam_has_both_speeds_on_both_axes():
    corners = beam_course(BeamScan(cycles=1))
    speeds = {
        (axis, round(abs(after[axis] - before[axis]) / (after_s - before_s)))
        for (before_s, before), (after_s, after) in pairwise(corners)
        for axis in range(2)
    }
    assert speeds == {(axis, speed) for axis in range(2) for speed in (0, 80, 240)}


def test_what_is_wrong_is_one_line_before_anything_moves():
    (fast,) = wrong_with("collector_scan", loop="left", amplitude_mm=20.0)
    assert "collector.hexapod.velocity_limit_mm_s is 8" in fast
    far = wrong_with("collector_scan", loop="left", amplitude_mm=60.0, frequency_hz=0.01)
    assert "the motion goes 120 mm from end to end; collector.hexapod.travel.z_mm has 50" in far
    (long,) = wrong_with("collector_scan", loop="left", frequency_hz=1e-12)
    assert long == "would take 1.2e+13 s; a step takes at most 604800 s"
    (direct,) = wrong_with("collector_scan", loop="right")
    assert direct == "loop right has no link; its star does not come over the collector"
    (still,) = wrong_with("collector_scan", load_rig(default_rig_path()))
    assert still == "rig fit-mock has no collector that moves"
    for name in ("beam_scan", "ambient"):
        (star,) = wrong_with(name, loop="left")
        assert star == f"{name} is for a metrology loop; left points a star"
    (alike,) = wrong_with("beam_scan", loop="metrology", slow_sky_arcsec_s=200.0)
    assert alike == "slow_sky_arcsec_s must be at most half of fast_sky_arcsec_s"
    (wide,) = wrong_with("beam_scan", loop="metrology", span_sky_arcsec=1e6)
    assert wide == "span_sky_arcsec must be at most 1500, the siderostat's travel_sky_arcsec"
    (wild,) = wrong_with("beam_scan", loop="metrology", fast_sky_arcsec_s=5000.0)
    assert "too fast for the pace of the telemetry" in wild
    few = load_rig(RIGS / "fit-testbed.toml", ["service.commands_per_s=5.0"])
    (slow,) = wrong_with("beam_scan", few, loop="metrology")
    assert "too fast for the pace of the telemetry and of commands" in slow


def test_only_the_last_attempt_that_was_done_counts():
    def attempt(began_s, outcome):
        return SequenceAttempt(
            time_s=began_s + 5.0, sequence_name="tried", step_number=1, step="ambient", loop="metrology",
            attempt=1, began_s=began_s, ended_s=began_s + 5.0, outcome=outcome, message="", figures_json="{}",
        )  # fmt: skip

    class Ticked:
        loop = "metrology"

        def __init__(self, time_s):
            self.time_s = time_s

        def __getattr__(self, _name):
            return 0.0

    Ticked.__name__ = "MetrologyTick"
    records = [
        *(Ticked(float(s)) for s in range(8)), attempt(1.0, "done"),
        *(Ticked(float(s)) for s in range(10, 18)), attempt(11.0, "failed"),
    ]  # fmt: skip
    found = gather_step(records, MetrologyTick, "metrology", "ambient")
    assert found["time_s"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    with pytest.raises(IdentifyError, match="no attempt at the step beam_scan"):
        gather_step(records, MetrologyTick, "metrology", "beam_scan")


def test_without_a_log_the_sequence_is_named(capsys):
    with pytest.raises(SystemExit) as end:
        main(["identify", "link_delay", "--simulate"])
    assert end.value.code == 2
    assert "with the step beam_scan" in capsys.readouterr().err
