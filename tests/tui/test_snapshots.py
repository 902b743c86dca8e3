"""The whole screen as it looks, at the sizes that people use. ``pytest --snapshot-update`` accepts a change.

Each console goes through all sizes, which takes a third of the time of a console for each.
"""

import asyncio

import pytest
from pytest_textual_snapshot import SVGImageExtension

from fitctl.messages.telemetry import LearningState
from fitctl.tui.commands import COMMISSIONING, VIEWS
from tests.instruments.fake_supervisor import MODE_NUMBERS, TESTBED, FakeSupervisor
from tests.samples.learner_reports import LINE, learnt_json, report
from tests.tui.commissioned import OUTPUT, commissioning
from tests.tui.fixed import FixedApp, make_logs, settle
from tests.tui.wrong import (
    ALARMS,
    drive_fault,
    fault_and_lost_records,
    link_lost,
    stopped_testbed,
)

SIZES = [(80, 24), (120, 40), (200, 60)]
SMALL = SIZES[:1]
OF_NO_MODE = {"sequences", "logs"}  # which look the same in every mode


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """A folder of logs that has the same name in every run."""
    make_logs(tmp_path / "logs")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def changed(snapshot):
    """Look at a console, on some screens and at some sizes; which pictures differ from those that are kept."""
    picture = snapshot.use_extension(SVGImageExtension)

    async def look(app, keys, views, sizes):
        found = []
        async with app.run_test(size=sizes[0]) as pilot:
            app.feed()
            await pilot.press(*keys)
            for size in sizes:
                await pilot.resize_terminal(*size)
                for view in views or [None]:
                    if view is not None:
                        await pilot.press(view.key)
                    await settle(app, pilot)
                    name = "-".join([*([view.name] if view else []), "{}x{}".format(*size)])
                    if app.export_screenshot() != picture(name=name):
                        found.append(name)
        return found

    def changed(app, *keys, views=(), sizes=SIZES):
        return asyncio.run(look(app, keys, views, sizes))

    return changed


OFTEN_TESTED = {"VERNIER", "star_lost", "drive_fault", "faulty_testbed"}  # each takes seconds


@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize(
    "mode",
    [
        pytest.param(mode, marks=[] if mode in OFTEN_TESTED else pytest.mark.long)
        for mode in MODE_NUMBERS
    ],
)
def test_every_screen_in_every_mode(changed, mode):
    views = [view for view in VIEWS if mode == "VERNIER" or view.name not in OF_NO_MODE]
    assert changed(FixedApp(FakeSupervisor(mode)), views=views) == []


@pytest.mark.long
def test_the_steps_on_a_console_of_operation(changed):
    assert changed(FixedApp(FakeSupervisor()), views=[COMMISSIONING]) == []


@pytest.mark.long
def test_a_step_of_the_commissioning_asks(changed):
    app = commissioning(printed=OUTPUT)
    assert changed(app, "g") == []


@pytest.mark.long
@pytest.mark.parametrize(
    "keys", ["e", "v", "o", "t", "j"], ids=["events", "alarms", "off", "target", "jog"]
)
def test_dialog(changed, keys):
    app = FixedApp(FakeSupervisor("VERNIER" if keys in "tje" else "STANDBY"))
    assert changed(app, *keys, sizes=SMALL) == []


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(wrong, marks=[] if wrong in OFTEN_TESTED else pytest.mark.long)
        for wrong in ALARMS
    ],
)
def test_alarm(changed, wrong):
    assert changed(FixedApp(ALARMS[wrong]())) == []


def test_alarms_of_a_fault(changed):
    assert changed(FixedApp(fault_and_lost_records()), "v", sizes=SMALL) == []


@pytest.mark.long
@pytest.mark.parametrize("loops", [("right",), TESTBED], ids=["one", "three"])
def test_stale(changed, loops):
    assert changed(FixedApp(FakeSupervisor(loops=loops), silent_s=7.2)) == []


def test_no_data_since_the_start(changed):
    app = FixedApp(FakeSupervisor(), silent_s=7.2)
    app.recorded = []
    assert changed(app, sizes=SMALL) == []


@pytest.mark.long
@pytest.mark.parametrize("state", ["VERNIER", "fault", "stopped"])
def test_without_colour(changed, monkeypatch, state):
    monkeypatch.setenv("NO_COLOR", "1")
    states = {"VERNIER": FakeSupervisor, "fault": drive_fault, "stopped": stopped_testbed}
    assert changed(FixedApp(states[state]())) == []


LEARNT = {
    "advice": {"setting": "advise", "state": "advice"},
    "in_force": {
        "setting": "on",
        "state": "in force",
        "design_json": learnt_json(LINE),
        "expected_px": 0.0262,
        "measured_px": 0.0271,
        "before_px": 0.0978,
    },
}


@pytest.mark.long
@pytest.mark.parametrize("learnt", LEARNT)
def test_what_was_learnt(changed, learnt):
    supervisor = FakeSupervisor()
    supervisor.learning = LearningState(
        text="air k/b1 0.87 px/s², b2/b1 4.8 1/s; noise 0.0100 px; lines 6.00 Hz 0.050 px; the model fits "
        "(p = 0.43)",
        report=report(),
        **LEARNT[learnt],
    )
    if learnt == "in_force":
        supervisor.controller = "learnt"
    views = [view for view in VIEWS if view.name == "loop"]
    assert changed(FixedApp(supervisor), views=views) == []


@pytest.mark.long
def test_three_loops(changed):
    views = [view for view in VIEWS if view.name in {"operate", "devices", "loop"}]
    assert changed(FixedApp(FakeSupervisor(loops=TESTBED)), views=views) == []


@pytest.mark.long
@pytest.mark.parametrize("chosen", ["right", "metrology"])
@pytest.mark.parametrize("state", ["OFF", "ACQUISITION", "link_lost", "stopped"])
def test_three_loops_on_operate(changed, state, chosen):
    states = {"link_lost": link_lost, "stopped": stopped_testbed}
    make = states.get(state, lambda: FakeSupervisor(state, loops=TESTBED))
    keys = ["l"] if chosen == "metrology" else []
    assert changed(FixedApp(make()), *keys) == []


def test_two_loops_on_a_wide_and_low_terminal(changed):
    app = FixedApp(FakeSupervisor(loops=("right", "left")))
    assert changed(app, "l", sizes=[(120, 24)]) == []


@pytest.mark.long
def test_the_past_while_an_alarm_of_now_rings(changed):
    supervisor = FakeSupervisor(loops=TESTBED)
    app = FixedApp(supervisor)
    supervisor.records_lost = 7
    app.recorded += supervisor.messages(1)
    assert changed(app, "less_than_sign") == []
