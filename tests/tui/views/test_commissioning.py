"""The Commissioning screen: it shows the record, and passes questions and answers on."""

import sys
import time

import pytest
from textual.widgets import Input

from fitctl.messages.commands import Stop
from fitctl.tui import jobs
from fitctl.tui.commands import SCREENS
from fitctl.tui.dialogs import Ask, Confirm
from fitctl.tui.jobs import Job
from fitctl.tui.steps import StepFacts, StepList
from fitctl.tui.widgets.header import Header
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.commissioned import GO, OUTPUT, RIG, commissioning
from tests.tui.fixed import FakeJob, FixedApp, settle
from tests.tui.live import header_text, notifications
from tests.tui.piloted import pressed, run, run_app, sent

LIMIT_S = 30.0


def shown(app, widget):
    panel = app.view.query_one(widget)
    return [panel.render_line(y).text.rstrip() for y in range(panel.content_size.height)]


def on_console(scenario, printed=OUTPUT):
    app = commissioning(printed)

    async def settled(pilot):
        await settle(app, pilot)
        await scenario(app, pilot)

    run_app(app, settled)
    return app


def running(app):
    """The one process that does steps."""
    (job,) = [job for job in app.jobs if job.asks]
    return job


def test_it_opens_on_the_steps_and_the_next_one_is_chosen():
    async def scenario(app, pilot):
        assert app.view.view_name == "commissioning"
        assert app.jobs[0].arguments == ["commission", "--list", "--json", *RIG]
        steps = "\n".join(shown(app, StepList))
        assert "not commissioned: right.stacks failed" in steps
        for state in ("passed", "skipped", "corrected", "failed", "to do"):
            assert state in steps
        facts = "\n".join(shown(app, StepFacts))
        assert "right.stacks: Each D/A channel moves its stack" in facts
        assert "moves each stack by 0.3 V" in facts
        assert "stack 2: check the cable" in facts

    on_console(scenario)


@pytest.mark.long
def test_a_record_that_is_not_whole_is_told_and_ends_nothing(monkeypatch):
    async def scenario(app, pilot):
        assert app.view.query_one(StepList).step is None
        assert "fitctl commission --list" in notifications(app)

    monkeypatch.setattr(FakeJob, "text", lambda *_: '"done": true}]}')
    assert on_console(scenario).jobs[0].ended


@pytest.mark.long
def test_what_a_step_found_and_what_it_needs_is_beside_the_list():
    async def scenario(app, pilot):
        await pressed(app, pilot, "up")
        facts = " ".join(" ".join(shown(app, StepFacts)).split())
        assert "corrected 2026-11-23 17:00:35 UTC, done 2 times" in facts
        assert "siderostat.wiring.velocity_signs = [-1, 1]" in facts
        await pressed(app, pilot, "down", "down", "down")
        assert "needs right.star first" in " ".join(shown(app, StepFacts))

    on_console(scenario)


@pytest.mark.long
def test_silence_is_no_alarm_where_most_steps_have_no_supervisor():
    async def scenario(app, pilot):
        assert "no supervisor" in header_text(app)
        assert "NO DATA for" not in header_text(app)
        actions = {
            part.style.meta.get("@click")
            for line in app.view.query_one(Header).lines(120, low=False)
            for part in line
            if part.style
        }
        assert {f"app.view('{view.name}')" for view in SCREENS} <= actions
        assert not app.alarms.in_order

    on_console(scenario)


@pytest.mark.long
@pytest.mark.parametrize(("key", "answer"), [("y", "yes"), ("n", "no"), ("escape", "no")])
def test_a_step_begins_once_the_operator_has_said_yes_to_what_it_moves(key, answer):
    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        job = running(app)
        assert job.arguments == ["commission", *RIG]
        assert isinstance(app.screen, Confirm)
        assert "Moves: each stack by 0.3 V." in app.screen._question
        assert not job.answers
        await pressed(app, pilot, key)
        assert job.answers == [answer]
        assert not isinstance(app.screen, Confirm)

    on_console(scenario)


@pytest.mark.long
def test_each_question_is_asked_once_and_the_next_one_too():
    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        await pressed(app, pilot, "y")
        job = running(app)
        assert not isinstance(app.screen, Confirm)
        job.printed = (
            f"{OUTPUT}yes\n    passed: right.stacks, 5.0 s\n"
            "    right.star: The star is on the camera. About 60 s.\n"
            "    Moves: both motors, up to 13 rad.\n"
        )
        await settle(app, pilot)
        assert app.view.query_one(StepList).running == "right.star"
        assert any("◌ right.star" in line for line in shown(app, StepList))
        job.printed += GO
        await settle(app, pilot)
        assert "both motors" in app.screen._question
        assert "right.stacks" not in app.screen._question
        await pressed(app, pilot, "y")
        assert job.answers == ["yes", "yes"]

    on_console(scenario)


@pytest.mark.long
def test_the_chosen_step_is_repeated():
    async def scenario(app, pilot):
        await pressed(app, pilot, "up", "d")
        assert running(app).arguments == ["commission", *RIG, "--only", "right.amplifiers"]

    on_console(scenario)


@pytest.mark.long
def test_a_step_is_skipped_with_a_reason():
    async def scenario(app, pilot):
        await pressed(app, pilot, "n", "enter")
        assert isinstance(app.screen, Ask)  # there is no reason yet
        app.screen.query_one(Input).value = "no lamp tonight"
        await pressed(app, pilot, "enter")
        step = ["--only", "right.stacks", "--skip", "right.stacks=no lamp tonight"]
        assert running(app).arguments == ["commission", *RIG, *step]

    on_console(scenario, printed="")


@pytest.mark.parametrize("key", ["s", "space", "ctrl+s", "z"])
def test_stop_ends_the_step_also_over_its_question_and_on_another_screen(key):
    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        if key == "z":
            await pressed(app, pilot, "y")
        elif key == "s":
            await pressed(app, pilot, "y", "1")
        await pressed(app, pilot, key)
        assert running(app).interrupted
        assert "the step ends" in notifications(app)

    app = on_console(scenario)
    assert sent(app) == ([] if key == "z" else [Stop()])


@pytest.mark.long
def test_a_stop_without_reply_is_an_error_unless_nothing_runs():
    async def scenario(app, pilot):
        app._handle_reply(Stop(), None, "no reply")
        await pilot.pause()
        assert "no step and no supervisor runs" in notifications(app)
        assert "may still move" not in notifications(app)
        await pressed(app, pilot, "g")
        await pressed(app, pilot, "y")
        app._handle_reply(Stop(), None, "no reply")
        await pilot.pause()
        assert "may still move" in notifications(app)

    on_console(scenario)


@pytest.mark.long
def test_when_a_step_ends_its_question_goes_and_the_record_is_read_again():
    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        job = running(app)
        listings = len(app.jobs)
        job.status = 130
        await settle(app, pilot)
        assert not isinstance(app.screen, Confirm)
        assert [each.arguments[:2] for each in app.jobs[listings:]] == [["commission", "--list"]]
        await pressed(app, pilot, "g")
        assert len([each for each in app.jobs if each.asks]) == 2

    on_console(scenario)


@pytest.mark.long
def test_nothing_is_started_while_a_step_runs():
    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        await pressed(app, pilot, "y", "d", "g")
        assert running(app)
        assert "still running" in notifications(app)

    on_console(scenario)


@pytest.mark.long
@pytest.mark.parametrize(("key", "ends"), [("y", False), ("n", True)])
def test_a_hand_that_is_needed_is_asked_for(key, ends):
    cable = "    watching\nTake off the camera's network cable, then press Enter: "

    async def scenario(app, pilot):
        await pressed(app, pilot, "g")
        assert "Take off the camera's network cable." in app.screen._question
        await pressed(app, pilot, key)
        assert running(app).interrupted is ends
        assert len(running(app).answers) == (0 if ends else 1)

    on_console(scenario, cable)


@pytest.mark.long
def test_a_console_of_a_supervisor_shows_the_steps_and_does_none():
    async def scenario(app, pilot):
        await pressed(app, pilot, "7")
        assert app.jobs[-1].arguments == ["commission", "--list", "--json"]
        assert any("right.stacks" in line for line in shown(app, StepList))
        await pressed(app, pilot, "g", "d", "n")
        assert not [job for job in app.jobs if job.asks]
        assert "fitctl commission --console" in notifications(app)

    run(scenario)


@pytest.mark.long
def test_without_a_rig_file_the_screen_says_so():
    app = FixedApp(FakeSupervisor(), rig_arguments=None)

    async def scenario(pilot):
        app.feed()
        await pressed(app, pilot, "7")
        assert not [job for job in app.jobs if job.arguments[0] == "commission"]
        await pressed(app, pilot, "g")
        assert "--rig FILE" in notifications(app)

    run_app(app, scenario)


# ---------------------------------------------------------------- the process itself

ASKING = """
import signal, time
for number in signal.SIGINT, signal.SIGTERM:  # a shell's background job ignores SIGINT
    signal.signal(number, signal.default_int_handler)
def main():
    print("moves: a motor", flush=True)
    answer = input("Go? [no]: ")
    try:
        print(f"answer {answer}", flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        time.sleep(0.3)
        print("stands", flush=True)
main()
"""


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Starts a process that runs the given text in place of fitctl."""
    program, popen = tmp_path / "program.py", jobs.subprocess.Popen

    def start(text):
        program.write_text(text)
        monkeypatch.setattr(
            jobs.subprocess,
            "Popen",
            lambda _arguments, **options: popen([sys.executable, str(program)], **options),
        )
        return Job(["commission"], asks=True)

    return start


@pytest.fixture
def asking(started):
    """A process that asks."""
    job = started(ASKING)
    yield job
    job._process.kill()
    job._process.wait()


def until(condition):
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_reading_what_a_process_prints_does_not_make_it_write_over_it(started):
    job = started("for number in range(20000): print(number, flush=True)")
    while job.status is None:
        job.text()

    assert job.text() == "".join(f"{number}\n" for number in range(20000))[-jobs.MOST_BYTES :]
    job.end()


def test_a_question_is_an_unfinished_line_and_stop_ends_what_moves(asking):
    until(asking.question)
    assert asking.question() == "Go? [no]: "
    asking.answer("yes")
    until(lambda: "answer yes" in asking.text())
    assert asking.question() == ""
    asking.interrupt()
    until(lambda: asking.status is not None)
    assert "stands" in asking.text()
    asking.answer("too late")
    asking.interrupt()
    asking.end()


def test_what_moves_is_not_killed_before_it_stands(asking, monkeypatch):
    monkeypatch.setattr(jobs, "END_WAIT_S", 0.01)
    until(asking.question)
    asking.answer("yes")
    until(lambda: "answer yes" in asking.text())
    asking.end()
    until(lambda: asking.status is not None)
    assert asking.status == 0
