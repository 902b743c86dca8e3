"""Another frame rate for a while: by command or for the learner, and always back to the rig file's."""

import math

import numpy as np
import pytest
from instruments.simulated import NEAR, SOON, SlowExecutor, events_of, failing, until
from samples.learner_reports import report

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceRefused, DeviceTimeout
from fitctl.logging.records import ControllerChange, Event
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    FrameRate,
    Off,
    SequenceReport,
    SequenceStatus,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive
from fitctl.simulation.simulation import Simulation
from fitctl.supervisor.frame_rate import FOR_LEARNER_S, PAUSE_S

TWO_STARS = default_rig_path().with_name("two-stars.toml")
USUAL_S, OTHER_S = 1 / 50.0, 1 / 48.0
REFUSED = DeviceRefused("camera", "here", "48 frames/s from now on", "access denied")
SILENT = DeviceTimeout("camera", "here", "an answer", "none")


@pytest.fixture
def held():
    """A rig that holds its star, and may act on what its learner reports; the test is its learner."""
    records = []
    rig = load_rig(default_rig_path(), ["loops.right.learn=on", SOON])
    simulation = Simulation(rig, 0, record=records.append, **NEAR)
    simulation.records = records
    simulation.learners.clear()
    for command in (Standby(), Acquire()):
        assert simulation.command(command).accepted
    until(simulation, Mode.VERNIER)
    simulation.run(5.0)
    return simulation


@pytest.fixture
def held_pair():
    """Two loops on one camera, of which one is in use."""
    records = []
    simulation = Simulation(load_rig(TWO_STARS), 0, record=records.append)
    simulation.records = records
    assert simulation.command(Standby(loop="right")).accepted
    simulation.run(1.0)
    return simulation


def period_s(simulation):
    """Of the last frames."""
    exposed_s = [tick.mid_exposure_s for tick in simulation.ticks if tick.loop == "right"]
    return np.diff(exposed_s[-20:]).mean()


def told(simulation):
    return [event.message for event in events_of(simulation) if event.source == "camera"]


def why_not(simulation, **values):
    reply = simulation.command(FrameRate(**values))
    return "" if reply.accepted else reply.text


# ---------------------------------------------------------------- by command


@pytest.mark.long
def test_the_camera_runs_at_another_rate_for_a_while_and_the_star_is_held(held):
    assert why_not(held, rate_hz=48.0, duration_s=10.0) == ""
    held.run(9.0)
    assert period_s(held) == pytest.approx(OTHER_S)
    held.run(2.0)

    assert period_s(held) == pytest.approx(USUAL_S)
    assert told(held) == ["runs at 48 Hz for 10 s", "runs at 50 Hz again"]
    assert held.ticks[-1].mode == "VERNIER"
    assert max(abs(tick.error_az_px) for tick in held.ticks[-500:]) < 0.2


def test_other_values_are_refused(held):
    assert "must be 45 to 49 Hz, got 50" in why_not(held, rate_hz=50.0)
    assert "must be 45 to 49 Hz, got 20" in why_not(held, rate_hz=20.0)
    assert "must be 45 to 49 Hz, got nan" in why_not(held, rate_hz=math.nan)
    too_long = why_not(held, rate_hz=48.0, duration_s=600.0)
    assert "duration_s must be 1 to 120, got 600" in too_long


def test_a_second_change_is_refused_until_the_first_has_ended(held):
    assert why_not(held, rate_hz=48.0, duration_s=5.0) == ""
    held.run(0.1)
    assert "runs at 48 Hz already" in why_not(held, rate_hz=47.0)
    held.run(6.0)
    assert why_not(held, rate_hz=47.0) == ""


def test_a_closed_camera_has_no_rate():
    simulation = Simulation(load_rig(default_rig_path()), 0)

    assert "needs an open camera" in why_not(simulation, rate_hz=48.0)


def test_a_camera_that_is_opened_again_runs_as_the_rig_file_says(held):
    assert why_not(held, rate_hz=48.0, duration_s=60.0) == ""
    held.run(1.0)
    for command in (Stop(), Off()):
        assert held.command(command).accepted
        held.run(2.0)
    assert held.command(Standby()).accepted
    held.run(2.0)

    assert period_s(held) == pytest.approx(USUAL_S)
    assert why_not(held, rate_hz=47.0) == ""


def test_opening_another_loop_does_not_make_the_change_last(held_pair):
    """The swarm found that the supervisor took the camera for one just opened, and left its rate changed."""
    assert why_not(held_pair, rate_hz=48.0, duration_s=5.0) == ""
    held_pair.run(1.0)
    assert held_pair.command(Standby(loop="left")).accepted
    held_pair.run(5.0)

    assert period_s(held_pair) == pytest.approx(USUAL_S)
    assert told(held_pair)[-1] == "runs at 50 Hz again"


def test_an_experiment_has_the_rigs_rate(held, monkeypatch):
    setting = SlowExecutor()
    drive = Drive(
        channel="siderostat_az", shape="sine", amplitude=2.0, frequency_hz=1.0, duration_s=2.0
    )
    experiment = Experiment(name="sine", drives=[drive])
    assert why_not(held, rate_hz=48.0, duration_s=2.0) == ""
    held.run(1.0)
    monkeypatch.setattr(held.supervisor._frame_rate, "_executor", setting)
    for _ in range(3):  # at last the time is over, but the camera has not confirmed its usual rate
        reply = held.command(experiment)
        assert reply.text == (
            "experiment needs the rig's frame rate; wait until the camera runs as usual again"
        )
        held.run(1.0)

    setting.finish()
    held.run(0.5)
    assert held.command(experiment).accepted
    held.run(1.0)

    assert held.ticks[-1].mode == "EXPERIMENT"
    assert period_s(held) == pytest.approx(USUAL_S)
    assert "an experiment needs the rig's frame rate" in why_not(held, rate_hz=47.0)


# ---------------------------------------------------------------- cameras that do not obey


def test_a_camera_that_keeps_its_rate_goes_on(held):
    held.camera.set_frame_rate = failing(REFUSED)
    assert why_not(held, rate_hz=48.0) == ""
    held.run(1.0)

    assert "keeps its frame rate: camera at here" in told(held)[0]
    assert held.ticks[-1].mode == "VERNIER"
    assert why_not(held, rate_hz=47.0) == ""


def test_a_rate_that_is_not_known_is_set_back(held):
    change, asked_hz = held.camera.set_frame_rate, []

    def late(rate_hz):
        asked_hz.append(rate_hz)
        change(rate_hz)
        if rate_hz == 48.0:
            raise SILENT

    held.camera.set_frame_rate = late
    assert why_not(held, rate_hz=48.0) == ""
    held.run(1.0)

    assert asked_hz == [48.0, 50.0]
    assert period_s(held) == pytest.approx(USUAL_S)
    assert "may run at 48 or 50 Hz" in told(held)[0]
    assert held.ticks[-1].mode == "VERNIER"


def test_a_camera_that_cannot_be_set_back_has_failed(held):
    assert why_not(held, rate_hz=48.0, duration_s=2.0) == ""
    held.run(1.0)
    held.camera.set_frame_rate = failing(SILENT)
    held.run(2.0 + held.rig.camera.device.heartbeat_s)

    assert held.ticks[-1].mode == "SAFE"


def test_a_camera_that_does_not_answer_for_a_moment_is_set_back_then(held):
    assert why_not(held, rate_hz=48.0, duration_s=2.0) == ""
    held.run(1.0)
    change, held.camera.set_frame_rate = held.camera.set_frame_rate, failing(SILENT)
    held.run(2.0)
    held.camera.set_frame_rate = change
    held.run(1.0)

    assert held.ticks[-1].mode == "VERNIER"
    assert period_s(held) == pytest.approx(USUAL_S)


# ---------------------------------------------------------------- for the learner


@pytest.mark.long
def test_the_learner_gets_its_rate_once_and_later_again(held):
    wish = report(worth_it=False, classifying_rate_hz=48.0)
    assert held.command(wish).accepted
    held.run(2.0)
    assert period_s(held) == pytest.approx(OTHER_S)
    held.run(FOR_LEARNER_S)
    assert period_s(held) == pytest.approx(USUAL_S)
    held.command(wish)
    held.run(2.0)
    assert period_s(held) == pytest.approx(USUAL_S)


def test_a_design_that_is_worth_it_comes_before_another_rate(held):
    held.command(report(classifying_rate_hz=48.0))
    held.run(3.0)
    change, rate = (
        next(record.time_s for record in held.records if isinstance(record, kind) and is_it(record))
        for kind, is_it in (
            (ControllerChange, lambda one: one.target == "learnt"),
            (Event, lambda one: one.message == "runs at 48 Hz for 12 s"),
        )
    )

    assert change <= rate


@pytest.mark.long
def test_after_a_pause_the_learner_gets_its_rate_again(held):
    wish = report(worth_it=False, classifying_rate_hz=48.0)
    held.command(wish)
    held.run(PAUSE_S)
    held.command(wish)
    held.run(4.0)

    assert period_s(held) == pytest.approx(OTHER_S)


def test_a_rate_that_cannot_be_is_no_wish(held):
    for wish_hz in (0.0, 10.0, 50.0, math.nan):
        assert held.command(report(worth_it=False, classifying_rate_hz=wish_hz)).accepted
        held.run(2.0)
        assert period_s(held) == pytest.approx(USUAL_S), wish_hz


@pytest.mark.long
def test_a_wish_of_long_ago_is_forgotten(held):
    held.command(SetTarget(az_px=22.0, el_px=19.5, loop="right"))
    held.command(report(worth_it=False, classifying_rate_hz=48.0))
    for target_px in np.linspace(22.0, 24.0, 30):  # the loop is never calm meanwhile
        held.command(SetTarget(az_px=float(target_px), el_px=19.5, loop="right"))
        held.run(1.0)
    held.run(5.0)

    assert period_s(held) == pytest.approx(USUAL_S)


def test_of_two_loops_that_ask_the_rigs_first_gets_its_rate(held_pair, monkeypatch):
    supervisor, now_s = held_pair.supervisor, held_pair.ticks[-1].time_s
    for loop in supervisor.stellar_loops.values():
        monkeypatch.setattr(loop.learning, "may_act", lambda _now_s: True)
    for name, rate_hz in (("left", 47.0), ("right", 48.0)):
        supervisor._asked_rates[name] = rate_hz, now_s
    held_pair.run(3.0)

    assert list(supervisor.stellar_loops) == ["right", "left"]
    assert told(held_pair) == ["runs at 48 Hz for 12 s"]


def test_a_sequence_that_begins_ends_the_change(held):
    assert why_not(held, rate_hz=48.0, duration_s=60.0) == ""
    held.run(1.0)
    status = SequenceStatus(run="1", name="night", state="running", steps=3)
    assert held.command(SequenceReport(status=status)).accepted
    held.run(1.0)

    assert period_s(held) == pytest.approx(USUAL_S)


def test_an_experiment_of_another_loop_keeps_the_rigs_rate(held_pair):
    for loop in ("right", "left"):
        held_pair.command(Standby(loop=loop))
        held_pair.run(1.0)
    supervisor = held_pair.supervisor
    supervisor.loops["left"].mode = Mode.EXPERIMENT

    assert "an experiment needs the rig's frame rate" in supervisor._why_no_other_rate()


def test_a_sequence_keeps_the_rigs_rate(held):
    status = SequenceStatus(run="1", name="night", state="running", steps=3)
    assert held.command(SequenceReport(status=status)).accepted
    held.command(report(worth_it=False, classifying_rate_hz=48.0))
    held.run(2.0)

    assert period_s(held) == pytest.approx(USUAL_S)


def test_with_advice_alone_the_rate_stays():
    simulation = Simulation(load_rig(default_rig_path()), 0, **NEAR)
    for command in (Standby(), Acquire()):
        assert simulation.command(command).accepted
    until(simulation, Mode.VERNIER)
    simulation.run(5.0)
    simulation.command(report(worth_it=False, classifying_rate_hz=48.0))
    simulation.run(2.0)

    assert period_s(simulation) == pytest.approx(USUAL_S)
