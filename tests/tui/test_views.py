"""The console's screens as an operator uses them: keys and clicks in, commands out."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from fitctl.supervisor.messages import (
    Hold,
    Jog,
    Look,
    Reset,
    SequenceControl,
    SequenceStatus,
    SetBiasOffset,
    SetTarget,
    Stop,
)
from fitctl.tui.commands import KEYS, OPERATOR_COMMANDS, VIEWS, keys_of
from fitctl.tui.dialogs import Alarms, Ask, Confirm, Reader
from fitctl.tui.views.sequences import parsed
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.hand import Hand
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.loglist import LogList
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.readings import Readings
from fitctl.tui.widgets.sequencing import Parameters, SequenceList
from tests.tui.fake import FakeSupervisor
from tests.tui.fixed import FixedApp, make_logs, settle

Scenario = Callable[[FixedApp, Pilot], Awaitable[None]]


def run(
    scenario: Scenario,
    mode: str = "VERNIER",
    *,
    supervisor: FakeSupervisor | None = None,
    size: tuple[int, int] = (120, 40),
    log_folder: Path = Path("logs"),
) -> FixedApp:
    """A console that has heard 21 s of telemetry, and a scenario on it."""
    app = FixedApp(supervisor or FakeSupervisor(mode), log_folder=log_folder)

    async def main() -> None:
        async with app.run_test(size=size, notifications=True) as pilot:
            app.feed()
            await pilot.pause()
            await scenario(app, pilot)

    asyncio.run(main())
    return app


def sent(app: FixedApp):
    """What went out, once all threads that send are done."""
    return app._wire._link.sent


async def pressed(app: FixedApp, pilot: Pilot, *keys: str) -> None:
    await pilot.press(*keys)
    await settle(app, pilot)


# ---------------------------------------------------------------- screens


def test_every_screen_is_a_key_a_click_and_a_palette_entry_away():
    async def scenario(app, pilot):
        for view in VIEWS:
            await pressed(app, pilot, view.key)
            assert app.view.view_name == view.name
        named = {command.title for command in app.get_system_commands(app.screen)}
        assert {f"Screen: {view.label}" for view in VIEWS} <= named
        await pressed(app, pilot, "1")
        tabs = app.view.query_one("#header").render_line(2).text
        await pilot.click("#header", offset=(tabs.index("Devices"), 2))
        await settle(app, pilot)
        assert app.view.view_name == "devices"

    run(scenario)


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
@pytest.mark.parametrize("key", ["s", "space", "ctrl+s"])
def test_stop_is_one_key_on_every_screen(view, key):
    async def scenario(app, pilot):
        await pilot.press(view.key, key)

    assert sent(run(scenario)) == [Stop()]


def test_stop_is_one_click_on_every_screen():
    async def scenario(app, pilot):
        for view in VIEWS:
            await pressed(app, pilot, view.key)
            await pilot.click("#keys", offset=(3, 0))
            await pilot.pause()

    assert sent(run(scenario)) == [Stop()] * len(VIEWS)


@pytest.mark.parametrize("opening", [("1", "o"), ("v",), ("4", "g"), ("4", "f")])
def test_stop_reaches_through_every_dialog(opening):
    async def scenario(app, pilot):
        await pressed(app, pilot, *opening)
        assert app.screen.is_modal
        await pilot.press("ctrl+s")

    assert sent(run(scenario, "STANDBY")) == [Stop()]


def test_commands_work_on_every_screen():
    async def scenario(app, pilot):
        for view in VIEWS:
            await pressed(app, pilot, view.key)
            await pilot.press("h")

    assert sent(run(scenario)) == [Hold(loop="right")] * len(VIEWS)


def test_no_key_means_two_things_on_one_screen():
    for view in VIEWS:
        keys = [
            *(command.key for command in OPERATOR_COMMANDS),
            "space",
            *(each.key for each in VIEWS),
            *(key for each in (*keys_of(view.name), *keys_of("")) for key in each.keys.split(",")),
        ]
        assert len(keys) == len(set(keys)), view.name


def test_every_key_is_in_the_help():
    async def scenario(app, pilot):
        await pressed(app, pilot, "6")
        told = "\n".join(
            "".join(segment.text for segment in strip)
            for strip in app.screen._compositor.render_strips()
        )
        for key in KEYS:
            assert key.label in told
        for command in OPERATOR_COMMANDS:
            assert command.help in told

    run(scenario, size=(120, 110))


@pytest.mark.parametrize("size", [(80, 24), (480, 130)])
def test_the_smallest_and_the_largest_terminal_show_every_screen(size):
    async def scenario(app, pilot):
        for view in VIEWS:
            await pressed(app, pilot, view.key)
            assert "STOP" in app.view.query_one(Keys).render_line(0).text

    run(scenario, size=size)


# ---------------------------------------------------------------- operate


def test_a_target_is_put_with_the_cursor_and_confirmed():
    async def scenario(app, pilot):
        await pressed(app, pilot, "t", "right", "right", "up")
        assert app.view.query_one(FocalPlane).cursor_px == (25.0, 20.0)
        assert "Set target" in app.view.query_one(Keys).render_line(0).text
        assert not sent(app)
        await pressed(app, pilot, "enter")

    assert sent(run(scenario)) == [SetTarget(loop="right", az_px=25.0, el_px=20.0)]


def test_a_click_puts_the_cursor_and_moves_nothing_by_itself():
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await settle(app, pilot)
        assert app.view.query_one(FocalPlane).cursor_px == (10.0, 28.5)
        assert not sent(app)
        await pressed(app, pilot, "escape", "enter")

    assert sent(run(scenario)) == []


def test_the_window_is_put_on_another_star_with_the_same_cursor():
    async def scenario(app, pilot):
        await pressed(app, pilot, "i", "left", "left", "down")
        assert app.view.query_one(FocalPlane).cursor_px == (23.0, 19.0)
        assert "Look here" in app.view.query_one(Keys).render_line(0).text
        assert not sent(app)
        await pressed(app, pilot, "i")
        assert app.view.query_one(FocalPlane).cursor_px is None

    assert sent(run(scenario)) == [Look(loop="right", az_px=23.0, el_px=19.0)]


def test_the_mouse_alone_puts_the_window_on_another_star():
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await settle(app, pilot)
        line = app.view.query_one(Keys).render_line(0).text
        await pilot.click(Keys, offset=(line.index("Look here"), 0))
        await settle(app, pilot)

    assert sent(run(scenario)) == [Look(loop="right", az_px=10.0, el_px=28.5)]


def test_the_cursor_stays_on_the_frame():
    async def scenario(app, pilot):
        await pressed(app, pilot, "t", *["left"] * 50)
        assert app.view.query_one(FocalPlane).cursor_px == (0.0, 19.5)

    run(scenario)


@pytest.mark.parametrize("mode", ["OFF", "STANDBY", "ACQUISITION", "SAFE"])
def test_no_target_is_put_without_a_star(mode):
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await pressed(app, pilot, "t", "enter")
        assert app.view.query_one(FocalPlane).cursor_px is None

    assert sent(run(scenario, mode)) == []


@pytest.mark.parametrize("mode", ["OFF", "STANDBY", "ACQUISITION", "COARSE", "VERNIER", "SAFE"])
def test_arrow_keys_move_nothing_unless_the_operator_has_taken_a_stage(mode):
    async def scenario(app, pilot):
        await pressed(app, pilot, "up", "down", "left", "right", "enter", "0")

    assert sent(run(scenario, mode)) == []


def test_the_siderostat_is_jogged_by_arrow_keys_with_a_choice_of_steps():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j", "right", "right_square_bracket", "up", "escape", "up")
        assert not app.view.query_one(Hand).display
        assert app.view.query_one(Events).display

    assert sent(run(scenario, "STANDBY")) == [
        Jog(loop="right", az_sky_arcsec=2.0, el_sky_arcsec=0.0),
        Jog(loop="right", az_sky_arcsec=0.0, el_sky_arcsec=10.0),
    ]


def test_the_mirror_is_put_off_its_bias_and_back():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j", "tab", "left")
        assert "JOG mirror" in app.view.query_one(Hand).render_line(0).text
        await pressed(app, pilot, "0")

    assert sent(run(scenario, "STANDBY")) == [
        SetBiasOffset(loop="right", az_urad=-5.0, el_urad=0.0),
        SetBiasOffset(loop="right", az_urad=0.0, el_urad=0.0),
    ]


def test_a_mode_that_allows_no_jog_takes_the_stage_out_of_the_operators_hand():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j")
        stopped = FakeSupervisor("SAFE")
        app.state.accept(stopped.message(), app.clock())
        await settle(app, pilot)
        assert app.view.hand == ""
        await pressed(app, pilot, "right")

    assert sent(run(scenario, "STANDBY")) == []


def test_nothing_is_jogged_by_old_data():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j")
        app.fixed_s += 5.0
        await settle(app, pilot)
        await pressed(app, pilot, "right")

    assert sent(run(scenario, "STANDBY")) == []


def test_picture_and_window_are_chosen_by_key():
    async def scenario(app, pilot):
        plane = app.view.query_one(FocalPlane)
        before = (plane.colours, plane.stretch, app.state.window)
        await pressed(app, pilot, "c", "x", "w")
        assert (plane.colours, plane.stretch) == ("viridis", "sqrt")
        assert app.state.window.rms_s == 60.0
        await pressed(app, pilot, "c", "c", "c", "x", "x", "w", "w")
        assert (plane.colours, plane.stretch, app.state.window) == before

    run(scenario)


# ---------------------------------------------------------------- alarms


def test_alarms_are_acknowledged_and_silenced_by_key_also_in_their_dialog():
    async def scenario(app, pilot):
        await settle(app, pilot)
        (alarm,) = app.alarms.in_order
        assert not alarm.acknowledged
        await pressed(app, pilot, "u")
        assert alarm.silenced
        await pressed(app, pilot, "v")
        assert isinstance(app.screen, Alarms)
        await pressed(app, pilot, "k", "escape")
        assert alarm.acknowledged
        assert not app.screen.is_modal

    supervisor = FakeSupervisor()
    supervisor.records_lost = 3
    run(scenario, supervisor=supervisor)


# ---------------------------------------------------------------- devices


def test_a_device_and_a_reading_are_told_in_full():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2", "down", "enter")
        assert isinstance(app.screen, Reader)
        assert app.screen._title == "right siderostat"
        await pressed(app, pilot, "escape", "tab", "down", "enter")
        assert app.screen._title == "fsm_edge"

    run(scenario)


def test_an_interlock_is_reset_from_its_row():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2", "n")  # no reading is chosen yet
        await pressed(app, pilot, "tab", "down", "down", "n")

    assert sent(run(scenario)) == [Reset(loop="right", name="following_error")]


def test_a_click_chooses_a_row_and_its_list():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2")
        await pilot.click(Readings, offset=(5, 4))
        await settle(app, pilot)
        readings = app.view.query_one(Readings)
        assert readings.active
        assert readings.now().name == "following_error"

    run(scenario)


# ---------------------------------------------------------------- sequences


def test_a_sequence_is_rehearsed():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "d")
        assert app.jobs[-1].arguments == ["sequence", "dry-run", "jog.toml"]
        assert not app.jobs[-1].outlives
        assert "last line" in app.view.query_one(Printed).render_line(2).text

    run(scenario)


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


def test_a_parameter_is_edited_checked_and_used():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", *["down"] * 6, "enter")
        assert isinstance(app.screen, Ask)
        app.screen.query_one(Input).value = "0.5"
        await pressed(app, pilot, "enter")
        job = app.jobs[-1]
        assert job.arguments[:2] == ["sequence", "check"]
        assert "jog_px = 0.5" in Path(job.arguments[2]).read_text()
        assert "jog*" in app.view.query_one(SequenceList).render_line(1).text
        await pressed(app, pilot, "d")
        assert app.jobs[-1].arguments[2] == job.arguments[2]
        edited.append(job.arguments[2])

    edited: list[str] = []
    run(scenario)
    assert not Path(edited[0]).exists()


def test_editing_is_left_by_escape_and_s_is_a_letter_there():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "down", "tab", "down", "enter", "s", "escape")
        assert not app.view.query_one(SequenceList).edited

    assert sent(run(scenario)) == []


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


@pytest.mark.parametrize(
    ("state", "wanted", "key", "action"),
    [
        ("running", "run", "p", "pause"),
        ("paused", "pause", "p", "resume"),
        ("running", "pause", "p", "resume"),
        ("running", "run", "z", "stop"),
    ],
)
def test_what_runs_is_paused_resumed_and_ended_wherever_it_was_started(state, wanted, key, action):
    supervisor = FakeSupervisor()
    supervisor.running_sequence = SequenceStatus(
        run="1", name="jog", state=state, steps=3, step_number=2, step="hold", wanted=wanted
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


def test_without_an_active_parameter_nothing_is_edited():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4", "enter")
        assert not app.screen.is_modal
        app.view.query_one(Parameters).chosen = 0
        await pressed(app, pilot, "tab", "enter")  # a step's own row
        assert not app.screen.is_modal

    run(scenario)


# ---------------------------------------------------------------- logs


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


def test_a_log_is_kept_and_no_longer(tmp_path):
    make_logs(tmp_path)
    mark = tmp_path / "fit-mock_20261132T031500Z.mcap.keep"

    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "m")
        assert mark.exists()
        await pressed(app, pilot, "m")
        assert not mark.exists()

    run(scenario, log_folder=tmp_path)


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


def test_a_folder_that_does_not_exist_is_an_empty_list(tmp_path):
    async def scenario(app, pilot):
        await pressed(app, pilot, "5", "enter", "m")
        assert "no log in" in app.view.query_one(LogList).render_line(1).text

    run(scenario, log_folder=tmp_path / "none")
