"""The learner beside a loop: which frames it learns from, when it reports, and what."""

import json
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import msgspec
import numpy as np
import pytest
from instruments.fake_supervisor import FakeSupervisor
from samples.learner_reports import SHAKEN, learnt_json

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.theory import loop_theory
from fitctl.learn.design_basis import estimated
from fitctl.learn.learner import EVERY_S, FIRST_S, SETTLE_S, WINDOW_S, Learner
from fitctl.learn.opened import rebuild
from fitctl.learn.process import LoopLearner
from fitctl.messages.commands import MAX_COMMAND_BYTES, Acquire, Standby
from fitctl.messages.telemetry import LearningState
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import true_residual_rms

PERIOD_S = 0.02


@pytest.fixture(scope="module")
def rig():
    return load_rig(default_rig_path(), SHAKEN)


@pytest.fixture(scope="module")
def ticks(rig):
    """Of the night with a line at 6 Hz, under the rig's own design."""
    simulation = Simulation(rig, 1)
    simulation.acquire()
    simulation.run(90.0)
    return [tick for tick in simulation.ticks if tick.loop == "right"]


@pytest.fixture(scope="module")
def vernier(ticks):
    held = [tick for tick in ticks if tick.mode == "VERNIER" and not tick.fsm_saturated]
    return held[round(SETTLE_S / PERIOD_S) :]


def fed(rig, ticks):
    learner = Learner(rig, "right")
    for tick in ticks:
        learner.add(tick)
    return learner


@pytest.mark.long
def test_a_first_report_is_due_after_a_minute_of_frames(rig, vernier):
    settle = round(SETTLE_S / PERIOD_S)
    assert not fed(rig, vernier[: round(FIRST_S / PERIOD_S)]).due
    assert fed(rig, vernier[: settle + round(FIRST_S / PERIOD_S) + 1]).due


@pytest.mark.parametrize(
    "disturbed",
    [
        {"mode": "EXPERIMENT"},
        {"mode": "COARSE"},
        {"star_visible": False},
        {"fsm_saturated": True},
        {"held": True},
        {"number": -1},
    ],
    ids=lambda change: next(iter(change)),
)
@pytest.mark.long
def test_frames_of_a_disturbed_loop_are_left_out(rig, vernier, disturbed):
    learner = fed(rig, [msgspec.structs.replace(tick, **disturbed) for tick in vernier])

    assert learner.frames == 0


def test_a_tick_without_a_frame_disturbs_none_of_the_others(rig, vernier):
    """At 500 Hz a busy computer has one every few seconds; until the next frame, the stages are held."""
    late = [msgspec.structs.replace(tick, number=-1, held=True) for tick in vernier[100::100]]
    ticks = sorted([*vernier, *late], key=lambda tick: tick.time_s)

    assert fed(rig, ticks).frames == fed(rig, vernier).frames


def test_after_a_step_of_the_target_frames_are_left_out(rig, vernier):
    before, after = vernier[:1000], vernier[1000:1500]
    stepped = [msgspec.structs.replace(tick, target_az_px=25.0) for tick in after]
    kept = fed(rig, before).frames

    assert fed(rig, before + stepped).frames == kept + 500 - round(SETTLE_S / PERIOD_S)


@pytest.mark.long
def test_a_long_night_is_learnt_from_its_last_minutes_in_as_much_memory(rig, vernier):
    """A year of frames needs no more than four minutes of them, and what is older is forgotten."""
    frames = round(WINDOW_S / PERIOD_S)
    learner = fed(rig, vernier[:1])
    before = learner._ring.nbytes
    at_s = vernier[0].time_s
    for number in range(frames + 1500):
        at_s += PERIOD_S
        tick = vernier[number % len(vernier)]
        learner.add(msgspec.structs.replace(tick, time_s=at_s, mid_exposure_s=at_s))
    report = learner.report(design_for(rig, "right"), learner.begin_report())

    assert learner.frames == frames
    assert learner._ring.nbytes == before
    assert report.evaluated_s == pytest.approx(WINDOW_S, rel=0.01)


@pytest.mark.long
def test_a_report_has_the_night_and_a_design_that_can_be_made_again(rig, ticks):
    learner = fed(rig, ticks)
    learner.watch("minimum-variance", 0.0)
    report = learner.report(design_for(rig, "right"), learner.begin_report())

    assert report.worth_it
    assert "6.0" in report.text
    assert report.bound_px <= report.learnt_px < 0.3 * report.present_px
    assert report.measured_px == pytest.approx(0.1, rel=0.3)
    assert report.noise_px == pytest.approx(basis(rig, "right").noise_px, rel=0.1)
    assert design_for(rig, "right", report.design_json).learnt
    assert len(msgspec.msgpack.encode(report)) < MAX_COMMAND_BYTES
    assert not learner.due


def test_most_lines_still_fit_into_a_command():
    lines = [{"frequency_hz": np.pi, "damping": np.pi / 700, "rms_px": np.pi / 70}] * 8
    document = json.loads(learnt_json()) | {"lines": lines, "guard": lines[0]}

    assert 2 * len(json.dumps(document)) < MAX_COMMAND_BYTES


def test_without_a_long_enough_piece_the_report_says_so(rig, vernier):
    learner = fed(rig, vernier[:300])
    report = learner.report(design_for(rig, "right"), learner.begin_report())

    assert not report.design_json
    assert not report.worth_it
    assert "the longest piece in VERNIER at 50 Hz is" in report.text


@pytest.mark.long
def test_a_learning_loop_leaves_little_of_a_night_that_its_rig_file_does_not_know():
    night = load_rig(default_rig_path(), [*SHAKEN, "loops.right.learn=on"])
    simulation = Simulation(night, 1, history_s=200.0)
    simulation.acquire()
    simulation.run(150.0)
    loop = simulation.supervisor.stellar_loops["right"]
    left_px = true_residual_rms(simulation.plants["right"], loop.target_px, 120.0, 150.0)

    assert loop.controller == "learnt"
    assert left_px.max() < 0.030  # 0.1 px with the rig's own design


# ---------------------------------------------------------------- beside a supervisor


def message(ticks, **state):
    telemetry = FakeSupervisor().message()
    loop = msgspec.structs.replace(telemetry.loops[0], **state)
    return msgspec.structs.replace(telemetry, ticks=list(ticks), loops=[loop])


@pytest.mark.long
def test_the_process_reports_once_it_has_heard_enough(rig, ticks):
    learner = LoopLearner(rig, "right")
    reports = []
    with ThreadPoolExecutor(1) as executor:
        for first in range(0, len(ticks), 500):
            heard = message(ticks[first : first + 500], controller="minimum-variance")
            learner.hear(heard, heard.loops[0])
            reports.append(learner.work(executor))
        executor.submit(int).result()
        reports.append(learner.work(executor))
    (report,) = (each for each in reports if each is not None)

    assert report.loop == "right"
    assert report.worth_it


@pytest.mark.long
def test_the_process_knows_the_learnt_design_in_force(rig, ticks):
    learning = LearningState(setting="on", state="in force", design_json=learnt_json())
    heard = message(ticks, controller="learnt", learning=learning)
    learner = LoopLearner(rig, "right")
    learner.hear(heard, heard.loops[0])
    with ThreadPoolExecutor(1) as executor:
        assert learner.work(executor) is None
        executor.submit(int).result()
        report = learner.work(executor)

    assert report.present_px == pytest.approx(
        0.1, rel=0.3
    )  # it was made for a night without the line


@pytest.mark.long
def test_a_report_on_a_design_that_is_not_in_force_any_more_is_left_out(rig, ticks):
    heard = message(ticks, controller="minimum-variance")
    learner = LoopLearner(rig, "right")
    learner.hear(heard, heard.loops[0])
    with ThreadPoolExecutor(1) as executor:
        learner.work(executor)
        later = message([], controller="eq20")
        learner.hear(later, later.loops[0])
        executor.submit(int).result()
        assert learner.work(executor) is None


def test_another_light_of_the_star_begins_a_new_night(rig, vernier, monkeypatch):
    monkeypatch.setattr("fitctl.learn.learner.FIRST_S", 1.0)
    learner = LoopLearner(rig, "right")
    for noise_px, is_due in ((None, True), (0.036, False), (0.037, False)):
        heard = message(vernier[:500] if is_due else [], noise_px=noise_px)
        learner.hear(heard, heard.loops[0])
        assert learner._learner.due is is_due
    later = message(vernier[500:], noise_px=0.037)
    learner.hear(later, later.loops[0])
    assert learner._learner.due


def test_a_new_night_begins_while_a_report_waits_for_that_of_another_loop(
    rig, vernier, monkeypatch
):
    """One thread makes the reports of all loops. The first of the new night is due after the longer time."""
    monkeypatch.setattr("fitctl.learn.learner.FIRST_S", 1.0)
    monkeypatch.setattr("fitctl.learn.learner.EVERY_S", 0.2)
    learner = LoopLearner(rig, "right")
    heard = message(vernier[:500])
    learner.hear(heard, heard.loops[0])
    other_is_done = Event()
    with ThreadPoolExecutor(1) as executor:
        executor.submit(other_is_done.wait, 60.0)
        learner.work(executor)
        dimmer = message([], noise_px=0.036)
        learner.hear(dimmer, dimmer.loops[0])
        other_is_done.set()
    soon = message(vernier[500:525], noise_px=0.036)
    learner.hear(soon, soon.loops[0])

    assert not learner._learner.due


def test_a_report_for_which_memory_does_not_suffice_says_so(rig, vernier, monkeypatch):
    def too_large(*_):
        raise MemoryError

    monkeypatch.setattr("fitctl.learn.learner.rebuild", too_large)
    report = reported(rig, vernier, monkeypatch, controller="minimum-variance")

    assert report.design_json == ""
    assert "too little memory" in report.text


def reported(rig, vernier, monkeypatch, **state):
    """The first report, on few frames; there is no second one."""
    monkeypatch.setattr("fitctl.learn.learner.FIRST_S", 1.0)
    heard = message(vernier[:500], **state)
    learner = LoopLearner(rig, "right")
    learner.hear(heard, heard.loops[0])
    with ThreadPoolExecutor(1) as executor:
        learner.work(executor)
        executor.submit(int).result()
        report = learner.work(executor)
        assert learner.work(executor) is None
    return report


def test_a_design_that_cannot_be_made_gives_a_report_with_the_reason(rig, vernier, monkeypatch):
    report = reported(rig, vernier, monkeypatch, controller_file="gone.json")

    assert report.design_json == ""
    assert "gone.json" in report.text


def test_nothing_is_learnt_by_a_design_file_that_has_changed_since_it_was_loaded(
    rig, vernier, monkeypatch, tmp_path
):
    file = tmp_path / "mine.json"
    loaded = design_for(rig, "right", "minimum-variance")
    state = {"controller_file": str(file), "controller_digest": loaded.digest}
    save_design(loaded, file)
    assert "mine.json" not in reported(rig, vernier, monkeypatch, **state).text

    save_design(design_for(rig, "right", "fslq"), file)
    report = reported(rig, vernier, monkeypatch, **state)

    assert report.design_json == ""
    assert "has changed since the loop loaded it" in report.text


def test_after_a_long_gap_only_new_frames_count(rig, vernier):
    learner = fed(rig, vernier)
    later_s = WINDOW_S + 1000.0
    for tick in vernier[:200]:
        learner.add(msgspec.structs.replace(tick, time_s=tick.time_s + later_s))

    assert learner.frames == 200
    assert not learner.due


@pytest.mark.long
def test_a_star_that_a_command_says_to_move_is_no_disturbance():
    """Its rate is in no rig file: the siderostat's motion after it must not look like the night's."""
    rate = "plant.loops.right.star_rate_sky_arcsec_s={az=12.0,el=-9.0}"
    simulation = Simulation(load_rig(default_rig_path(), [rate]), 1)
    for command in (
        Standby(),
        Acquire(rate_az_sky_arcsec_s=12.0, rate_el_sky_arcsec_s=-9.0),
    ):
        assert simulation.command(command).accepted
    simulation.run(40.0)
    ticks = [tick for tick in simulation.ticks if tick.mode == "VERNIER"]
    series = rebuilt(simulation.supervisor.rig, ticks[round(SETTLE_S / PERIOD_S) :])

    assert len(series.disturbance_px) > 1000
    assert np.ptp(series.disturbance_px, axis=0).max() < 3.0  # it moved by more than 80 px


@pytest.mark.long
def test_reports_follow_each_other_by_their_time(rig, vernier):
    learner = fed(rig, vernier)
    learner.report(design_for(rig, "right"), learner.begin_report())
    frames = round(EVERY_S / PERIOD_S)
    later = [msgspec.structs.replace(tick, time_s=tick.time_s + 100.0) for tick in vernier[:frames]]
    for tick in later[:-1]:
        learner.add(tick)
    assert not learner.due
    learner.add(later[-1])
    assert learner.due


def rebuilt(rig, ticks):
    columns = {
        name: np.array([getattr(tick, name) for tick in ticks])
        for name in ticks[0].__struct_fields__
    }
    theory = loop_theory(rig, "right", design_for(rig, "right"))
    (series,) = rebuild(theory, columns, [np.arange(len(ticks))])
    return series


def gain_of(rig, ticks):
    """The mirror's, as estimated from the frames of ticks."""
    return estimated([rebuilt(rig, ticks)], basis(rig, "right"))[0].mirror_gain


@pytest.mark.long
def test_commands_that_were_confirmed_late_do_not_change_the_mirrors_gain(rig, vernier):
    """The D/A had acted in time: its answer came after the next frame had been exposed."""
    late = np.random.default_rng(0).choice(len(vernier) - 4, len(vernier) // 20, replace=False)
    seen = list(vernier)
    for row in late:
        seen[row] = msgspec.structs.replace(seen[row], time_s=seen[row].time_s + 0.006)
        before, met = seen[row + 1], seen[row + 2]
        seen[row + 2] = msgspec.structs.replace(
            met, mirror_az_rad=before.mirror_az_rad, mirror_el_rad=before.mirror_el_rad
        )
    known, found = gain_of(rig, vernier), gain_of(rig, seen)

    assert rebuilt(rig, vernier).filled == 0
    assert rebuilt(rig, seen).filled == len(late)
    assert found.value == pytest.approx(known.value, abs=0.1)
