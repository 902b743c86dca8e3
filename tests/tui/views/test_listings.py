"""The screens with lists: devices and readings, sequences, logs."""

import math
import shutil
from pathlib import Path

import pytest
from textual.widgets import Input

from fitctl.messages.commands import Reset, SequenceControl, SequenceStatus
from fitctl.tui.dialogs import Ask, Confirm, Reader
from fitctl.tui.views.sequences import parsed, typed
from fitctl.tui.widgets.loglist import LogList
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.readings import Readings
from fitctl.tui.widgets.sequencing import Parameters, SequenceList
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FakeJob, make_logs, settle
from tests.tui.live import notifications
from tests.tui.piloted import pressed, run, sent, typed_at_once

# ---------------------------------------------------------------- devices


@pytest.mark.long
def test_a_device_and_a_reading_are_told_in_full():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2", "down", "enter")
        assert isinstance(app.screen, Reader)
        assert app.screen._title == "right siderostat"
        await pressed(app, pilot, "escape", "tab", "down", "enter")
        assert app.screen._title == "amplifier_slow"

    run(scenario)


@pytest.mark.long
def test_an_interlock_is_reset_from_its_row():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2", "n")  # no reading is chosen yet
        await pressed(app, pilot, "tab", "down", "down", "n")

    assert sent(run(scenario)) == [Reset(loop="right", name="dac_slow")]


@pytest.mark.long
def test_keys_typed_faster_than_drawn_go_to_the_list_that_tab_chose():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down")
        await typed_at_once(app, pilot, "tab", "pagedown", "enter")
        assert isinstance(app.screen, Ask)
        await pressed(app, pilot, "escape", "2")
        await typed_at_once(app, pilot, "tab", "down", "down", "n")
        await pressed(app, pilot, "1", "2")
        await typed_at_once(app, pilot, "shift+tab", "enter")
        assert isinstance(app.screen, Reader)
        assert app.screen._title == "camera"

    assert sent(run(scenario)) == [Reset(loop="right", name="dac_slow")]


@pytest.mark.long
def test_a_click_chooses_a_row_and_its_list():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2")
        await pilot.click(Readings, offset=(5, 4))
        await settle(app, pilot)
        readings = app.view.query_one(Readings)
        assert readings.has_focus
        assert readings.now().name == "dac_slow"

    run(scenario)


# ---------------------------------------------------------------- sequences


@pytest.mark.long
def test_a_sequence_is_rehearsed():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "d")
        assert app.jobs[-1].arguments == ["sequence", "dry-run", "jog.toml", "--present"]
        assert not app.jobs[-1].outlives
        assert "last line" in app.view.query_one(Printed).render_line(2).text

    run(scenario)


@pytest.mark.long
@pytest.mark.parametrize(("answer", "runs"), [("y", True), ("n", False)])
def test_a_sequence_runs_on_the_instrument_once_the_operator_says_yes(answer, runs):
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "g")
        assert isinstance(app.screen, Confirm)
        await pressed(app, pilot, answer)
        started = [job for job in app.jobs if job.arguments[:2] == ["sequence", "run"]]
        assert [job.arguments[2] for job in started] == (["jog.toml"] if runs else [])
        assert all(job.outlives for job in started)

    app = run(scenario)
    assert all(job.ended for job in app.jobs if job.arguments[:2] == ["sequence", "run"])


@pytest.mark.long
def test_a_parameter_is_edited_checked_and_used():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", *["down"] * 6, "enter")
        assert isinstance(app.screen, Ask)
        app.screen.query_one(Input).value = "0.5"
        await pressed(app, pilot, "enter")
        job = app.jobs[-1]
        assert job.arguments[:2] == ["sequence", "check"]
        assert "dither_px = 0.5" in Path(job.arguments[2]).read_text()
        assert "dither*" in app.view.query_one(SequenceList).render_line(2).text
        await pressed(app, pilot, "d")
        assert app.jobs[-1].arguments[2] == job.arguments[2]
        edited.append(job.arguments[2])

    edited: list[str] = []
    run(scenario)
    assert not Path(edited[0]).exists()


@pytest.mark.long
@pytest.mark.parametrize(("status", "stays"), [(None, True), (0, False)])
def test_a_run_that_goes_on_without_the_console_keeps_its_file(status, stays):
    """It may not have read the file yet."""

    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", *["down"] * 6, "enter")
        app.screen.query_one(Input).value = "0.5"
        await pressed(app, pilot, "enter")
        start = app.start_job

        def started(arguments, **options):
            job = start(arguments, **options)
            job.status = None
            return job

        app.start_job = started
        await pressed(app, pilot, "g", "y")
        app.jobs[-1].status = status

    run_job = run(scenario).jobs[-1]
    assert run_job.arguments[:2] == ["sequence", "run"]
    edition = Path(run_job.arguments[2])
    assert edition.exists() is stays
    if stays:
        shutil.rmtree(edition.parent.parent)


@pytest.mark.long
def test_the_file_of_an_edited_sequence_is_written_once():
    """A process that was started with it may read it only after the next edit."""

    async def edited(app, pilot, value):
        await pressed(app, pilot, "enter")
        app.screen.query_one(Input).value = value
        await pressed(app, pilot, "enter")
        return Path(app.jobs[-1].arguments[2])

    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", *["down"] * 6)
        first = await edited(app, pilot, "0.5")
        written = first.stat()
        for _ in range(20):
            app.draw_all()
        second = await edited(app, pilot, "0.25")
        assert first.stat().st_mtime_ns == written.st_mtime_ns
        assert "dither_px = 0.5," in first.read_text()
        assert "dither_px = 0.25," in second.read_text()
        assert first.name == second.name == "dither.toml"

    run(scenario)


@pytest.mark.long
def test_editing_is_left_by_escape_and_s_is_a_letter_there():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", "down", "enter", "s", "escape")
        assert not app.view.query_one(SequenceList).edited

    assert sent(run(scenario)) == []


@pytest.mark.long
def test_a_file_of_ones_own_is_opened(tmp_path):
    path = tmp_path / "mine.toml"
    path.touch()

    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "f")
        app.screen.query_one(Input).value = str(tmp_path / "no.toml")
        await pressed(app, pilot, "enter")
        assert isinstance(app.screen, Ask)
        app.screen.query_one(Input).value = str(path)
        await pressed(app, pilot, "enter")
        assert ["sequence", "list", "--json", str(path)] in [job.arguments for job in app.jobs]

    run(scenario)


@pytest.mark.long
def test_a_file_name_that_is_too_long_is_refused_in_the_dialog():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "f")
        app.screen.query_one(Input).value = 300 * "x"
        await pressed(app, pilot, "enter")
        assert isinstance(app.screen, Ask)

    run(scenario)


@pytest.mark.long
def test_what_the_question_names_is_run_though_another_file_is_read_meanwhile():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down")
        named = app.view.query_one(SequenceList).document
        await pressed(app, pilot, "g")
        app.view._add([{"file": "other.yaml", "name": "other", "description": "", "steps": []}])
        assert app.view.query_one(SequenceList).document["name"] == "other"
        await pressed(app, pilot, "y")
        assert app.jobs[-1].arguments[:3] == ["sequence", "run", named["file"]]

    run(scenario)


@pytest.mark.long
def test_a_file_that_cannot_be_read_does_not_take_the_place_of_what_moves_the_stages(tmp_path):
    path = tmp_path / "mine.toml"
    path.touch()
    unreadable = FakeJob(["sequence", "check"])
    unreadable.status = 2

    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "g", "y")
        run_job = app.jobs[-1]
        run_job.status = None
        app.start_job = lambda *_arguments: unreadable
        await pressed(app, pilot, "f")
        app.screen.query_one(Input).value = str(path)
        await pressed(app, pilot, "enter")
        assert app.view.query_one(Printed).job is run_job
        assert "last line" in notifications(app)

    run(scenario)
    assert unreadable.ended


@pytest.mark.long
def test_a_list_of_sequences_that_is_not_whole_is_told_and_ends_nothing(monkeypatch):
    async def scenario(app, pilot):
        await pressed(app, pilot, "4")
        assert app.view.query_one(SequenceList).documents == []
        assert "fitctl sequence list --json: cannot be shown" in notifications(app)

    monkeypatch.setattr(FakeJob, "text", lambda *_: '"A star"}]')
    assert run(scenario).jobs[0].ended


@pytest.mark.long
@pytest.mark.parametrize(
    ("state", "wanted", "key", "action"),
    [
        ("running", "run", "p", "pause"),
        ("paused", "pause", "p", "resume"),
        ("running", "pause", "p", "resume"),
        ("running", "run", "z", "end"),
    ],
)
def test_what_runs_is_paused_resumed_and_ended_wherever_it_was_started(state, wanted, key, action):
    supervisor = FakeSupervisor()
    supervisor.running_sequence = SequenceStatus(
        run="1", name="dither", state=state, steps=3, step_number=2, step="hold", wanted=wanted
    )

    async def scenario(app, pilot):
        await pressed(app, pilot, "4", key)

    assert sent(run(scenario, supervisor=supervisor)) == [
        SequenceControl(loop="right", action=action)
    ]


@pytest.mark.parametrize(
    ("text", "value"),
    [("1.5", 1.5), ("3", 3), ("true", True), ("right", "right"), ('"a b"', "a b"), ("", "")],
)
def test_a_value_is_read_as_toml_or_as_text(text, value):
    assert parsed(text) == value


@pytest.mark.parametrize(
    "value",
    [
        "right",
        "",
        "007",
        "true",
        "a # b",
        'say "a\\b"',
        True,
        3,
        0.5,
        math.inf,
        [1, 2.5],
        [{"name": "a", "az": 1.0, "flux_dn": 900.0}, {"name": "b\u2028", "az": -2.0}],
    ],
    ids=repr,
)
def test_a_parameter_is_typed_as_it_is_read_again(value):
    assert parsed(typed(value)) == value
    assert type(parsed(typed(value))) is type(value)
    assert "\n" not in typed(value)


@pytest.mark.parametrize("text", ["0x" + 5000 * "F", 3000 * "["], ids=["digits", "depth"])
def test_what_toml_cannot_read_is_a_text(text):
    assert parsed(text) == text


@pytest.mark.long
def test_without_an_active_parameter_nothing_is_edited():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "enter")
        assert not app.screen.is_modal
        app.view.query_one(Parameters).chosen = 0
        await pressed(app, pilot, "tab", "enter")  # a step's own row
        assert not app.screen.is_modal

    run(scenario)


# ---------------------------------------------------------------- logs


@pytest.mark.long
@pytest.mark.parametrize(
    ("key", "command"),
    [("enter", ["log", "info"]), ("f", ["log", "verify"]), ("t", ["report"]), ("y", ["replay"])],
)
def test_a_log_is_looked_into_by_the_command_for_it(tmp_path, key, command):
    make_logs(tmp_path)

    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "down", key)
        log = str(tmp_path / "fit-mock_20261131T031500Z.mcap")
        assert app.jobs[-1].arguments == [*command, log]

    run(scenario, log_folder=tmp_path)


@pytest.mark.long
def test_a_log_is_kept_and_no_longer(tmp_path):
    make_logs(tmp_path)
    mark = tmp_path / "fit-mock_20261132T031500Z.mcap.keep"

    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "m")
        assert mark.exists()
        await pressed(app, pilot, "m")
        assert not mark.exists()

    run(scenario, log_folder=tmp_path)


@pytest.mark.long
def test_the_log_that_is_recorded_is_marked_and_a_new_one_does_not_take_the_choice(tmp_path):
    make_logs(tmp_path)
    (tmp_path / "fit-mock-20261130T031500Z.mcap").touch()

    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "down", "down")
        logs = app.view.query_one(LogList)
        rows = [logs.render_line(y).text for y in range(1, 5)]
        assert [row for row in rows if "recording" in row and "fit-mock-2026" in row]
        chosen = logs.chosen_log.path
        (tmp_path / "another.mcap").touch()
        logs.look()
        assert logs.chosen_log.path == chosen

    run(scenario, log_folder=tmp_path)


@pytest.mark.long
def test_a_folder_that_does_not_exist_is_an_empty_list(tmp_path):
    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "enter", "m")
        assert "no log in" in app.view.query_one(LogList).render_line(1).text

    run(scenario, log_folder=tmp_path / "none")
