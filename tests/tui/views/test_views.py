"""The console's screens as an operator uses them: keys and clicks in, commands out."""

import pytest

from fitctl.messages.commands import Release, Stop
from fitctl.tui.commands import KEYS, OPERATOR_COMMANDS, SCREENS, keys_of
from fitctl.tui.widgets.keys import Keys
from tests.tui.fixed import settle
from tests.tui.live import screen_text
from tests.tui.piloted import pressed, run, sent

# ---------------------------------------------------------------- screens


@pytest.mark.long
def test_every_screen_is_a_key_a_click_and_a_palette_entry_away():
    async def scenario(app, pilot):
        for view in SCREENS:
            await pressed(app, pilot, view.key)
            assert app.view.view_name == view.name
        named = {command.title for command in app.get_system_commands(app.screen)}
        assert {f"Screen: {view.label}" for view in SCREENS} <= named
        await pressed(app, pilot, "1")
        tabs = app.view.query_one("#header").render_line(2).text
        await pilot.click("#header", offset=(tabs.index("Devices"), 2))
        await settle(app, pilot)
        assert app.view.view_name == "devices"

    run(scenario)


def test_stop_is_one_key_on_every_screen():
    async def scenario(app, pilot):
        stops = []
        for view in SCREENS:
            await pressed(app, pilot, view.key)
            for key in ("s", "space", "ctrl+s"):
                await pressed(app, pilot, key)
                stops.append(Stop())
                assert sent(app) == stops, (view.name, key)
                assert app.view.view_name == view.name

    run(scenario)


@pytest.mark.long
def test_stop_is_one_click_on_every_screen():
    async def scenario(app, pilot):
        for view in SCREENS:
            await pressed(app, pilot, view.key)
            await pilot.click("#keys", offset=(3, 0))
            await pilot.pause()

    assert sent(run(scenario)) == [Stop()] * len(SCREENS)


@pytest.mark.parametrize("opening", [("1", "o"), ("v",), ("4", "g"), ("4", "f")])
def test_stop_reaches_through_every_dialog(opening):
    async def scenario(app, pilot):
        await pressed(app, pilot, *opening)
        assert app.screen.is_modal
        await pilot.press("ctrl+s")

    assert sent(run(scenario, "STANDBY")) == [Stop()]


@pytest.mark.long
def test_commands_work_on_every_screen():
    async def scenario(app, pilot):
        for view in SCREENS:
            await pressed(app, pilot, view.key)
            await pilot.press("h")

    assert sent(run(scenario)) == [Release(loop="right")] * len(SCREENS)


def test_no_key_means_two_things_on_one_screen():
    for view in SCREENS:
        keys = [
            *(command.key for command in OPERATOR_COMMANDS),
            "space",
            *(each.key for each in SCREENS),
            *(key for each in (*keys_of(view.name), *keys_of("")) for key in each.keys.split(",")),
        ]
        assert len(keys) == len(set(keys)), view.name


@pytest.mark.long
def test_help_is_left_for_the_screen_before():
    async def scenario(app, pilot):
        for key in ("escape", "question_mark"):
            await pressed(app, pilot, "2", "question_mark")
            assert app.view.view_name == "help"
            await pressed(app, pilot, key)
            assert app.view.view_name == "devices"

    run(scenario)


@pytest.mark.long
def test_escape_in_a_filtered_help_shows_everything_first():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3", "question_mark", "slash", *"jog", "escape")
        assert app.view.view_name == "help"
        await pressed(app, pilot, "escape")
        assert app.view.view_name == "loop"

    run(scenario)


@pytest.mark.long
def test_the_past_is_left_from_the_help_too():
    async def scenario(app, pilot):
        await pressed(app, pilot, "question_mark", "comma")
        assert not app.state.live
        await pressed(app, pilot, "home")
        assert not app.state.live
        await pressed(app, pilot, "end")
        assert app.state.live

    run(scenario)


@pytest.mark.long
def test_every_key_is_in_the_help():
    async def scenario(app, pilot):
        await pressed(app, pilot, "6")
        told = screen_text(app)
        for key in KEYS:
            assert key.label in told
        for command in OPERATOR_COMMANDS:
            assert command.help in told

    run(scenario, size=(120, 150))


@pytest.mark.long
@pytest.mark.parametrize("size", [(80, 24), (480, 130)])
def test_the_smallest_and_the_largest_terminal_show_every_screen(size):
    async def scenario(app, pilot):
        for view in SCREENS:
            await pressed(app, pilot, view.key)
            assert "STOP" in app.view.query_one(Keys).render_line(0).text

    run(scenario, size=size)


@pytest.mark.long
def test_the_arrows_of_a_list_in_the_footer_are_buttons():
    async def scenario(app, pilot):
        await pressed(app, pilot, "2")
        chosen = app.view.focused.chosen
        footer = app.view.query_one(Keys).render_line(0).text
        await pilot.click("#keys", offset=(footer.index("↓"), 0))
        await settle(app, pilot)
        assert app.view.focused.chosen == chosen + 1

    run(scenario)


@pytest.mark.parametrize("opening", [("o",), ("v",), ("e",), ("ctrl+p",)])
@pytest.mark.long
def test_stop_is_a_bright_button_at_the_top_right_of_every_dialog(opening):
    async def scenario(app, pilot):
        await pressed(app, pilot, *opening)
        assert app.screen.is_modal
        await pilot.click(offset=(app.size.width - 4, 0))
        await pilot.pause()

    assert sent(run(scenario, "STANDBY")) == [Stop()]
