import dataclasses
import math

import numpy as np
import pytest
from samples.forged_logs import forged, with_values
from samples.learner_reports import LINE, report
from samples.report_samples import record

from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.figures.rigs import with_controller
from fitctl.logging.errors import LogError
from fitctl.logging.records import LoopTiming, Tick
from fitctl.logging.schemas import TOPICS
from fitctl.messages.commands import SetController
from fitctl.model.hysteresis import half_widths_v, stack_gains
from fitctl.report import tables
from fitctl.report.findings import find
from fitctl.report.gather import counted
from fitctl.report.run import find_run
from fitctl.report.stages import stacks


def test_the_residual_is_that_of_the_ticks(held, findings):
    simulation, _ = held
    loop = findings.loops["right"]
    rows = loop.selection.rows
    errors = np.array([tick.error_az_px for tick in simulation.ticks])[rows]

    assert loop.verdict.word == "met"
    assert loop.residual["az"].rms == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-5)
    assert loop.residual["az"].low < loop.residual["az"].rms < loop.residual["az"].high


def test_the_only_controller_of_a_run_needs_no_table(findings):
    loop = findings.loops["right"]

    assert len(loop.held_by_controller) == 1
    assert tables.by_controller(loop).rows == []


def test_the_rejection_is_measured_and_the_design_is_the_logged_one(rig, findings):
    (found,) = findings.loops["right"].rejections
    its_basis = basis(rig, "right")
    wanted = abs(1 + sampled_response(design_for(rig, "right"), its_basis)(np.array([2 * np.pi])))

    at_1_hz = next(row for row in found.table() if row[0] == 1.0)

    assert found.controller == rig.loops["right"].vernier.controller
    assert at_1_hz[2] == pytest.approx(wanted[0])
    # Eq. 20 does not know of the stacks' hysteresis, which takes a fifth of its gain.
    assert 0.6 < at_1_hz[1] / at_1_hz[2] < 1.1


def test_the_piston_is_what_the_plant_s_mirror_had(held, findings):
    """The voltages are all that the log has; the plant knows what the stacks did."""
    simulation, _ = held
    loop = findings.loops["right"]
    at_s = loop.ticks["time_s"]
    shown = at_s > at_s[-1] - 20.0
    true_m = simulation.plants["right"].history_piston_m(at_s[-1] - 20.0, at_s[-1])[:, 0]

    assert loop.stacks is not None
    assert np.ptp(loop.stacks.piston_m[shown]) == pytest.approx(np.ptp(true_m), rel=0.15, abs=2e-9)
    assert loop.stages.piston_rms_m == loop.stacks.piston_m[loop.selection.rows].std()


def test_without_identified_hysteresis_a_mock_s_own_is_taken_and_told(rig, findings):
    bare = rig.model_copy(deep=True)
    loop = bare.loops["right"]
    object.__setattr__(loop.fsm, "hysteresis", None)
    ticks = findings.loops["right"].ticks

    own = stacks(bare, "right", ticks)
    unknown = stacks(bare.model_copy(update={"plant": None}), "right", ticks)

    truth = rig.plant.loops["right"].hysteresis
    slope = stack_gains(truth, loop.fsm)[half_widths_v(truth) == 0].sum()
    assert own is not None
    assert "mock's own" in own.source
    assert np.abs(own.displacement_m).max() > slope * 0.05
    assert unknown is None


def test_the_commands_at_one_place_are_kept_by_where_the_target_came_from(findings):
    az, el = findings.loops["right"].stages.gaps

    assert [dwell.direction for dwell in az.dwells] == [0, 1, -1]
    assert [dwell.direction for dwell in el.dwells] == [0, 0, 0]
    assert az.dwells[1].target_px == pytest.approx(az.dwells[0].target_px + 1, abs=0.05)
    # A pixel of target costs about a pixel of command: what differs is air, hysteresis and play.
    assert az.dwells[1].command_px - az.dwells[2].command_px == pytest.approx(1.0, abs=0.6)
    assert np.isnan(az.px)  # no place was come to from both sides


def test_what_was_lost_late_and_when_is_counted(findings):
    loop = findings.loops["right"]

    assert findings.gathered.lost == 3
    assert loop.counts["frames"] == np.count_nonzero(loop.ticks["number"] >= 0)
    assert loop.mode_s["VERNIER"] == pytest.approx(loop.selection.held_s, abs=0.1)
    assert loop.timing["age_median_s"] == pytest.approx(0.035, abs=1e-4)


@pytest.mark.long
def test_each_controller_of_a_run_is_judged_by_itself(rig, tmp_path):
    def course(simulation):
        simulation.acquire()
        simulation.run(30.0)
        simulation.command(SetController(loop="right", name="minimum-variance"))
        simulation.run(12.0)

    path = tmp_path / "two.mcap"
    record(with_controller(rig, "right", "eq20"), path, course)

    loop = find(find_run([path])).loops["right"]
    found, held = loop.rejections, loop.held_by_controller

    assert [one.controller for one in found] == ["eq20", "minimum-variance"]
    assert [one.controller for one in held] == ["eq20", "minimum-variance"]
    assert sum(one.evaluated_s for one in held) == pytest.approx(
        loop.selection.evaluated_s, abs=0.1
    )
    squares = sum(one.evaluated_s * one.residual["az"].rms ** 2 for one in held)
    whole = loop.selection.evaluated_s * loop.residual["az"].rms ** 2
    assert squares == pytest.approx(whole, rel=0.01)
    assert tables.by_controller(loop).rows[1][0] == "minimum-variance"
    assert all(one.predicted is not None for one in found)
    assert found[1].evaluated_s == pytest.approx(12.0, abs=1.0)


@pytest.mark.long
def test_a_learnt_design_is_judged_as_it_was_logged(rig, tmp_path):
    def course(simulation):
        simulation.acquire()
        simulation.run(15.0)
        simulation.command(report(lines=(LINE,)))
        simulation.command(SetController(loop="right", name="learnt"))
        simulation.run(12.0)

    path = tmp_path / "learnt.mcap"
    record(with_controller(rig, "right", "eq20"), path, course)
    (found,) = (
        one
        for one in find(find_run([path])).loops["right"].rejections
        if one.controller == "learnt"
    )

    at_hz = found.spectra.frequency_hz
    assert found.predicted.rejection[np.abs(at_hz - LINE.frequency_hz).argmin()] > 2.0


@pytest.mark.long
def test_each_of_several_learnt_designs_is_compared_with_what_it_should_leave(rig, tmp_path):
    def course(simulation):
        simulation.acquire()
        simulation.run(15.0)
        for frequency_hz in (LINE.frequency_hz, LINE.frequency_hz + 2.0):
            simulation.command(
                report(lines=(dataclasses.replace(LINE, frequency_hz=frequency_hz),))
            )
            simulation.command(SetController(loop="right", name="learnt"))
            simulation.run(12.0)

    path = tmp_path / "learnt.mcap"
    record(with_controller(rig, "right", "eq20"), path, course)
    loop = find(find_run([path])).loops["right"]

    titles = ["eq20", "learnt", "learnt (2)"]
    assert [one.controller for one in loop.held_by_controller] == titles
    assert [one.controller for one in loop.rejections] == titles[1:]  # eq20 was too short
    first, second = (one.predicted.rejection for one in loop.rejections)
    assert not np.allclose(first, second, rtol=0.1)


def test_a_disturbance_that_cannot_be_designed_for_leaves_the_measurement(held, rig):
    air = rig.loops["right"].vernier.air_path.model_copy(update={"gain_px": 0.0})
    vernier = rig.loops["right"].vernier.model_copy(update={"air_path": air})
    loop = rig.loops["right"].model_copy(update={"vernier": vernier})
    without = rig.model_copy(update={"loops": {"right": loop}})

    (found,) = find(find_run([held[1]], without)).loops["right"].rejections

    assert found.predicted is None
    assert "air_path.gain_px" in found.why
    assert found.table()[0][1] > 1


def test_a_camera_that_is_opened_again_counts_its_lost_frames_anew():
    lost = np.array([2, 2, 3, 0, 0, 1], np.int32)

    assert counted(lost, before=2) == 2
    assert counted(lost[:0], before=0) == 0


def test_frames_that_were_lost_once_are_counted_once_and_one_second_without_servo_periods_hides_none(
    held, tmp_path
):
    middle_s = 40.0

    def change(entry):
        message = entry.message
        if entry.topic == TOPICS[Tick].format(loop="right") and message.time_s > middle_s:
            message.frames_lost = 2
        elif entry.topic == TOPICS[LoopTiming].format(loop="right"):
            message.servo_late_worst_s = math.nan if message.time_s < middle_s else 0.001
            message.servo_late_median_s = message.servo_late_worst_s

    loop = find(find_run([forged(held[1], tmp_path / "lost.mcap", change)])).loops["right"]

    assert loop.counts["frames_lost"] == 2
    assert loop.timing["servo_late_median_s"] == loop.timing["servo_late_worst_s"] == 0.001


def test_a_target_that_is_not_known_where_the_star_is_held_is_refused(held, tmp_path):
    topic = TOPICS[Tick].format(loop="right")
    path = with_values(held[1], tmp_path / "target.mcap", topic, target_az_px=math.nan)

    with pytest.raises(LogError, match="target_az_px"):
        find(find_run([path]))
