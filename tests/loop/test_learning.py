"""What a loop does with a learnt design: advise, change over without a bump, and go back."""

import dataclasses
import math

import numpy as np
import pytest
from instruments.simulated import SlowExecutor
from samples.learner_reports import PAPER, SHAKEN, report

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis
from fitctl.controllers.design.document import parameters_json
from fitctl.controllers.design.margins import design_with_margins
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.logging.records import ControllerChange, Event
from fitctl.loop import learning
from fitctl.loop.learning import CALM_S, PAUSE_S, Learning
from fitctl.messages.commands import (
    Acquire,
    LearnerReport,
    Release,
    SetController,
    SetTarget,
    Standby,
)
from fitctl.messages.modes import Mode
from fitctl.simulation.simulation import Simulation

TIMID = parameters_json(design_with_margins(dataclasses.replace(PAPER, noise_px=0.03)))


class Night:
    """A rig that holds its star; the test is its learner."""

    def __init__(self, *overrides, learn="on"):
        rig = load_rig(default_rig_path(), [*overrides, f"loops.right.learn={learn}"])
        self.records = []
        self.simulation = Simulation(rig, 1, record=self.records.append, history_s=60.0)
        self.simulation.learners.clear()
        self.rig = rig
        self.loop = self.simulation.supervisor.stellar_loops["right"]
        for command in (Standby(), Acquire()):
            assert self.simulation.command(command).accepted
        while self.loop.mode is not Mode.VERNIER:
            self.simulation.run(0.1)
        self.simulation.run(10.0)

    def report(self, **values):
        return self.simulation.command(report(**values))

    def events(self):
        return [record.message for record in self.records if isinstance(record, Event)]

    def changes(self):
        return [record for record in self.records if isinstance(record, ControllerChange)]

    def error_px(self, seconds):
        """True error over the last seconds, shape (steps, 2)."""
        part, now_s = self.simulation.plants["right"], self.simulation.clock.now_s()
        return part.history_px(now_s - seconds, now_s)[:, 0, 0] - self.loop.target_px


@pytest.fixture
def shaken():
    return Night(*SHAKEN)


# ---------------------------------------------------------------- advice


@pytest.mark.long
def test_advice_tells_the_gain_and_the_command_once(shaken):
    night = Night(*SHAKEN, learn="advise")
    for _ in range(3):
        assert night.report().accepted
        night.simulation.run(1.0)
    told = [text for text in night.events() if "learnt" in text]

    assert len(told) == 1
    assert "0.0240 px instead of 0.1000 (76% less; bound 0.0236)" in told[0]
    assert night.loop.learning.command in told[0]
    assert night.loop.controller == "minimum-variance"
    assert night.loop.state(0.0).learning.state == "advice"


@pytest.mark.long
def test_a_night_that_the_design_in_force_suits_gives_no_event():
    night = Night(learn="advise")
    night.report(worth_it=False)

    assert not any("learnt" in text for text in night.events())
    assert night.loop.state(0.0).learning.state == "kept"


def test_without_frames_no_learnt_design_is_used():
    night = Night()
    now_s = night.simulation.clock.now_s()

    assert night.loop.learning.is_calm(now_s + 0.02)
    assert not night.loop.learning.is_calm(now_s + 1.0)


@pytest.mark.long
def test_advice_is_withdrawn_with_its_reason(shaken):
    night = Night(*SHAKEN, learn="advise")
    night.report()
    night.report(worth_it=False, fits=False)

    assert any("no longer explains the frames" in text for text in night.events())


@pytest.mark.long
def test_advice_of_a_model_that_does_not_fit_says_so(shaken):
    night = Night(*SHAKEN, learn="advise")
    night.report(fits=False)

    assert any("does not explain the frames in full" in text for text in night.events())
    assert night.loop.state(0.0).learning.state == "advice"


@pytest.mark.long
def test_a_report_without_a_design_says_why_once():
    night = Night(learn="advise")
    for _ in range(2):
        night.simulation.command(
            LearnerReport(loop="right", design_json="", text="learn: too short", evaluated_s=60.0)
        )

    assert night.events().count("learn: too short") == 1
    assert night.loop.state(0.0).learning.state == "failed"


@pytest.mark.long
def test_the_operator_applies_what_was_advised():
    night = Night(*SHAKEN, learn="advise")
    refused = night.simulation.command(SetController(name="learnt"))
    night.report()
    assert night.simulation.command(SetController(name="learnt")).accepted

    assert not refused.accepted
    assert "nothing is learnt of loop right yet" in refused.text
    assert night.loop.controller == "learnt"
    assert night.changes()[-1].reason.startswith("operator; a design learnt from")


def test_parameters_without_margins_are_refused():
    night = Night(learn="on")
    greedy = design_minimum_variance(dataclasses.replace(PAPER, noise_px=0.0005))
    night.report(design_json=parameters_json(greedy))

    assert night.loop.controller == "eq20"
    assert "controller learnt: its margins are not those" in night.events()[-1]


@pytest.mark.long
@pytest.mark.parametrize(
    "figures",
    [
        {"present_px": 0.0},
        {"present_px": math.nan},
        {"learnt_camera_px": math.inf},
        {"learnt_px": 0.2},
        {"noise_px": 1e200},
        {"learnt_camera_px": 1e200},
    ],
)
def test_a_report_that_cannot_be_is_refused_and_changes_nothing(shaken, figures):
    reply = shaken.report(**figures)

    assert not reply.accepted
    assert "report" in reply.text
    assert not shaken.changes()


# ---------------------------------------------------------------- the change


@pytest.mark.long
@pytest.mark.parametrize("before", ["eq20", "minimum-variance"])
def test_the_change_is_without_a_bump(before):
    night = Night(*SHAKEN, f"loops.right.vernier.controller={before}")
    before_px = night.error_px(5.0)
    peak_px = np.abs(before_px - before_px.mean(axis=0)).max()
    night.report()
    night.simulation.run(2.0)
    after_px = np.abs(night.error_px(2.0))
    night.simulation.run(10.0)
    held_px = night.error_px(8.0)

    assert night.loop.controller == "learnt"
    assert after_px.max() < 1.25 * peak_px
    assert np.sqrt(np.mean(held_px**2, axis=0)).max() < 0.03  # 0.1 px before


@pytest.mark.long
def test_the_same_design_goes_on_where_it_was():
    """Had it begun from rest, it would not know the line for seconds."""
    nights = [Night(*SHAKEN) for _ in range(2)]
    for night in nights:
        night.report()
        night.simulation.run(20.0)
    nights[0].report()
    nights[1].report(worth_it=False)
    for night in nights:
        night.simulation.run(2.0)
    changed_px, unchanged_px = (night.error_px(2.0) for night in nights)

    assert [len(night.changes()) for night in nights] == [2, 1]
    assert np.abs(changed_px - unchanged_px).max() < 0.03  # 0.12 px if it began from rest


@pytest.mark.long
def test_another_design_does_not_begin_from_frames_before_a_gap(shaken, monkeypatch):
    pointing, camera = shaken.loop.pointing, shaken.simulation.supervisor._camera
    assert len(pointing.recent) == 150
    monkeypatch.setattr(camera, "ready", False)
    shaken.simulation.run(0.1)
    monkeypatch.setattr(camera, "ready", True)
    shaken.simulation.run(0.2)

    assert 1 < len(pointing.recent) < 15


@pytest.mark.long
def test_a_change_says_why_and_has_the_design(shaken):
    shaken.report()
    (change,) = shaken.changes()

    assert (change.source, change.target) == ("minimum-variance", "learnt")
    assert "would leave 0.0240 px instead of 0.1000" in change.reason
    assert '"learnt": true' in change.design_json


@pytest.mark.long
def test_a_newer_report_replaces_one_whose_design_has_not_been_begun(shaken, monkeypatch):
    executor = SlowExecutor()
    monkeypatch.setattr(shaken.simulation.supervisor._design_jobs, "_executor", executor)
    for learnt_px in (0.026, 0.025, 0.024):
        assert shaken.report(learnt_px=learnt_px).accepted
        shaken.simulation.run(0.1)
    executor.finish()
    shaken.simulation.run(0.1)

    (change,) = shaken.changes()
    assert "would leave 0.0240 px instead of 0.1000" in change.reason


@pytest.mark.long
def test_the_same_night_on_the_same_report_is_changed_at_once_and_only_once(shaken):
    shaken.report()
    shaken.report(worth_it=False)
    shaken.simulation.run(5.0)

    assert len(shaken.changes()) == 1


@pytest.mark.long
@pytest.mark.parametrize("learn", ["off", "advise"])
def test_nothing_changes_unless_the_rig_file_says_on(learn):
    night = Night(*SHAKEN, learn=learn)
    night.report()

    assert not night.changes()


@pytest.mark.long
def test_what_the_operator_chose_stays(shaken):
    shaken.simulation.command(SetController(name="fslq"))
    shaken.report()

    assert shaken.loop.controller == "fslq"
    assert any(shaken.loop.learning.command in text for text in shaken.events())


@pytest.mark.long
def test_while_the_target_moves_nothing_changes(shaken):
    shaken.simulation.command(SetTarget(az_px=24.5, el_px=19.5))
    shaken.simulation.run(0.2)
    shaken.report()
    assert not shaken.changes()

    shaken.simulation.run(15.0 + CALM_S)
    shaken.report()
    assert len(shaken.changes()) == 1


class RateStub:
    """Whether frames come at another rate is set by the test."""

    other = False

    def is_other(self, _exposed_s):
        return self.other


@pytest.mark.parametrize(
    "hindrance",
    [
        {"saturated": True},
        {"error_px": None},  # no star
        {"target_px": (20.2, 20.0)},
        {"hindered": True},  # not in VERNIER, an experiment, or an interlock
        {"now_s": CALM_S + 1.0},  # after a gap
        {"other_rate": True},
    ],
)
def test_nothing_changes_until_the_loop_has_been_calm_for_a_while(hindrance):
    learning = Learning(load_rig(default_rig_path(), ["loops.right.learn=on"]), "right")
    learning.accept(report())
    still = (np.zeros(2), np.zeros(2))
    learning._frame_rate = rate = RateStub()

    def observe(now_s, *, other_rate=False, **values):
        rate.other = other_rate
        frame = {"error_px": (0.0, 0.0), "target_px": (20.0, 20.0), "stages_rad": still}
        frame |= {"now_s": now_s, "exposed_s": now_s, "saturated": False, "hindered": False}
        learning.observe(**frame | values)
        return learning.wants_change(now_s)

    calm = [observe(0.02 * n) for n in range(round(CALM_S / 0.02) + 10)]
    begins_s = 0.02 * len(calm)
    observe(**{"now_s": begins_s} | hindrance)
    later_s = hindrance.get("now_s", begins_s) + 0.02
    again = [observe(later_s + 0.02 * n) for n in range(round(CALM_S / 0.02) + 10)]

    for wanted in (calm, again):
        assert not any(wanted[: round(CALM_S / 0.02) - 1])
        assert wanted[-1]


@pytest.mark.long
@pytest.mark.parametrize("sensor", ["centroid", "fit"])
def test_on_a_quiet_night_the_change_is_without_a_bump_too(sensor):
    night = Night(f"loops.right.sensor={sensor}", "loops.right.vernier.controller=minimum-variance")
    night.simulation.run(20.0)
    peak_px = np.abs(night.error_px(20.0)).max()
    truth = basis(night.rig, "right")
    learnt = design_with_margins(dataclasses.replace(truth, noise_px=1.5 * truth.noise_px))
    night.report(design_json=parameters_json(learnt))
    night.simulation.run(2.0)

    assert night.loop.controller == "learnt"
    assert np.abs(night.error_px(2.0)).max() < 1.25 * peak_px


# ---------------------------------------------------------------- the way back


@pytest.mark.long
def test_a_design_that_does_worse_is_left_within_a_second():
    """It was made for another night: it expects a strong line where there is none."""
    night = Night("loops.right.vernier.controller=minimum-variance")
    night.report(lines=(Line(4.0, 0.1, 0.3),), measured_px=0.0165, learnt_camera_px=0.0165)
    night.simulation.run(1.0)
    _, back = night.changes()

    assert (back.source, back.target) == ("learnt", "minimum-variance")
    assert "the learnt design leaves" in back.reason
    assert night.loop.state(0.0).learning.state == "fell back"


@pytest.mark.long
def test_a_design_that_does_worse_is_left_also_where_nothing_can_be_compared(monkeypatch):
    """As where the design before is unstable on the mirror that the learnt one was made for."""
    monkeypatch.setattr(learning, "comparison", lambda *_: None)
    night = Night("loops.right.vernier.controller=minimum-variance")
    night.report(lines=(Line(4.0, 0.1, 0.3),), measured_px=0.0165, learnt_camera_px=0.0165)
    night.simulation.run(1.0)

    assert [change.target for change in night.changes()] == ["learnt", "minimum-variance"]


@pytest.mark.long
def test_a_design_that_is_only_a_little_worse_is_left_too():
    """It was made for three times the noise, so it leaves a sixth more, which no quick look at frames shows."""
    night = Night("loops.right.vernier.controller=minimum-variance")
    night.report(design_json=TIMID, measured_px=0.02, learnt_camera_px=0.02)
    night.simulation.run(8.0)
    assert night.loop.controller == "learnt"

    night.simulation.run(30.0)
    _, back = night.changes()
    assert (back.source, back.target) == ("learnt", "minimum-variance")
    assert "the design before would have left" in back.reason


def learnt_design_at_work(**more):
    """On the paper's night, of which it leaves what it promised."""
    night = Night("loops.right.vernier.controller=minimum-variance")
    good = parameters_json(design_with_margins(PAPER))
    values = {"measured_px": 0.0165, "learnt_camera_px": 0.0165, "design_json": good} | more
    night.report(**values)
    night.simulation.run(10.0)
    assert night.loop.controller == "learnt"
    return night


@pytest.mark.long
def test_a_star_that_is_caught_again_is_no_reason_to_go_back():
    night = learnt_design_at_work()
    for command in (Release(), Acquire()):
        assert night.simulation.command(command).accepted
        night.simulation.run(1.0)
    while night.loop.mode is not Mode.VERNIER:
        night.simulation.run(0.1)
    night.simulation.run(6.0)

    assert len(night.changes()) == 1


@pytest.mark.long
@pytest.mark.parametrize("lasts_s", [0.02, 0.04, 0.1])
def test_a_gust_is_no_reason_to_go_back(lasts_s):
    night = learnt_design_at_work()
    part = night.simulation.plants["right"]
    begin_block, gusts = part.begin_block, iter([True])

    def with_a_gust():
        begin_block()
        if next(gusts, False):
            part._air_px[: round(lasts_s / part.constants.step_s), :, 0] += 1.0

    part.begin_block = with_a_gust
    night.simulation.run(15.0)

    assert np.abs(night.error_px(15.0)).max() > 0.9
    assert [change.reason for change in night.changes()[1:]] == []


def observe_frames(learning, errors_px, *, saturated=False, from_s=0.0, target_px=(28.0, 20.0)):
    """Frames of a star at rest on its target; the reasons to go back."""
    return [
        reason
        for number, error_px in enumerate(errors_px)
        if (
            reason := learning.observe(
                from_s + 0.02 * number,
                from_s + 0.02 * number - 0.02,
                (error_px, 0.0),
                target_px,
                (np.zeros(2), np.zeros(2)),
                saturated=saturated,
                hindered=False,
            )
        )
    ]


def test_a_mirror_that_is_saturated_for_a_while_is_no_reason_to_go_back():
    rig = load_rig(default_rig_path())
    before, now = design_minimum_variance(PAPER), design_with_margins(PAPER)
    learning = Learning(rig, "right")
    learning.changed(
        before, now, report(measured_px=0.016, learnt_camera_px=0.016), (), by_itself=True
    )

    assert observe_frames(learning, [0.016] * 100) == []
    assert observe_frames(learning, [2.0] * 100, saturated=True, from_s=2.0) == []
    assert observe_frames(learning, [0.016] * 1000, from_s=4.0) == []
    assert observe_frames(learning, [0.5] * 50, from_s=24.0)[0].startswith(
        "the learnt design leaves"
    )


@pytest.mark.long
def test_advice_for_one_star_is_not_for_a_star_of_another_light():
    night = Night("loops.right.vernier.controller=minimum-variance", learn="advise")
    night.report(design_json=parameters_json(design_with_margins(PAPER)))
    assert night.loop.state(0.0).learning.state == "advice"
    for command in (Release(), Acquire(star_flux_dn=14_000.0)):
        assert night.simulation.command(command).accepted
        night.simulation.run(0.1)

    reply = night.simulation.command(SetController(name="learnt"))
    assert (reply.accepted, night.loop.state(0.0).learning.state) == (False, "collecting")


@pytest.mark.long
def test_a_star_of_another_light_gets_the_design_before_without_a_pause():
    night = learnt_design_at_work()
    assert night.simulation.command(Release()).accepted
    night.simulation.run(1.0)
    assert night.simulation.command(Acquire(star_flux_dn=14_000.0)).accepted
    *_, back = night.changes()

    assert (back.source, back.target) == ("learnt", "minimum-variance")
    assert "the learnt design is for another light" in back.reason
    assert night.loop.learning.wants_change(math.inf) is False  # not calm, but not paused either
    assert night.loop.state(0.0).learning.state != "fell back"


@pytest.mark.long
def test_single_frames_without_the_star_do_not_keep_a_worse_design_in_force():
    night = Night("loops.right.vernier.controller=minimum-variance")
    night.report(design_json=TIMID, measured_px=0.02, learnt_camera_px=0.02)
    observe, frames = night.loop.learning.observe, iter(range(10_000))

    def some_without(now_s, exposed_s, error_px, *more, **others):
        lost = next(frames) % 600 == 599
        return observe(now_s, exposed_s, None if lost else error_px, *more, **others)

    night.loop.learning.observe = some_without
    night.simulation.run(60.0)
    _, back = night.changes()
    assert (back.source, back.target) == ("learnt", "minimum-variance")


@pytest.mark.long
def test_a_line_that_beats_is_no_reason_to_go_back():
    """For a third of a second it is thrice what it is over a minute, with either design."""
    night = Night(*SHAKEN)
    same = design_minimum_variance(dataclasses.replace(PAPER, noise_px=0.0101))
    night.loop.use(same, report=report(measured_px=0.06, learnt_camera_px=0.06), by_itself=True)
    night.simulation.run(20.0)

    assert len(night.changes()) == 1
    assert np.abs(night.error_px(20.0)).max() > 2 * 0.06


@pytest.mark.long
def test_a_night_that_becomes_louder_is_no_reason_to_go_back():
    """The design before would leave more, too."""
    louder = (
        "plant.timeline=[{at_s=20.0,loops={right={air_path={gain_px=1.2,b1_s2=0.517,b2_s=2.5}}}}]"
    )
    night = Night("loops.right.vernier.controller=minimum-variance", louder)
    same = design_with_margins(PAPER)
    night.report(design_json=parameters_json(same), measured_px=0.016, learnt_camera_px=0.016)
    night.simulation.run(65.0 - night.simulation.clock.now_s())
    state = night.loop.state(0.0).learning

    assert state.state == "in force"
    assert state.measured_px > 1.25 * 0.016
    assert state.before_px == pytest.approx(state.measured_px, rel=0.1)


@pytest.mark.long
def test_after_a_way_back_there_is_a_pause():
    night = Night(*SHAKEN)
    night.report(lines=(), measured_px=0.02, learnt_camera_px=0.02)
    night.simulation.run(5.0)
    night.report()
    assert night.loop.controller == "minimum-variance"

    night.simulation.run(PAUSE_S)
    night.report()
    assert night.loop.controller == "learnt"


@pytest.mark.long
def test_after_a_way_back_newer_advice_is_shown():
    night = Night(*SHAKEN, learn="advise")
    night.report(lines=(), measured_px=0.02, learnt_camera_px=0.02)
    assert night.simulation.command(SetController(name="learnt")).accepted
    night.simulation.run(5.0)
    assert night.loop.state(0.0).learning.state == "fell back"

    night.report()
    assert night.loop.state(0.0).learning.state == "advice"


@pytest.mark.long
def test_an_interlock_that_only_warns_does_not_keep_a_loop_from_learning(shaken):
    shaken.simulation.supervisor.report_quantity("clock_step_s", 5.0)
    shaken.simulation.run(1.0)
    assert shaken.loop.interlocks.action == "warn"
    shaken.report()
    shaken.simulation.run(3.0)

    assert shaken.loop.controller == "learnt"


@pytest.mark.long
def test_a_design_that_does_as_expected_stays(shaken):
    shaken.report()
    shaken.simulation.run(60.0)
    state = shaken.loop.state(0.0).learning

    assert state.state == "in force"
    assert state.measured_px == pytest.approx(state.expected_px, rel=0.2)
    assert state.before_px > 3 * state.measured_px
    assert math.isclose(state.expected_px, 0.026)
