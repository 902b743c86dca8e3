"""The console as an operator uses it: keys in, commands out, and what the screen says meanwhile."""

import msgspec
import pytest
from textual.command import CommandPalette

from fitctl.messages.commands import (
    Off,
    Release,
    Reply,
    Reset,
    SetController,
    SetTarget,
    Shutdown,
    Stop,
    TakeOver,
)
from fitctl.messages.telemetry import TrippedInterlock
from fitctl.tui.dialogs import Confirm
from tests.instruments.fake_supervisor import START_S, FakeSupervisor
from tests.tui.links import FakeLink
from tests.tui.live import header_text, notifications, run, until


@pytest.mark.parametrize(
    ("answer", "sent"), [("y", [Off(loop="right")]), ("n", []), ("escape", [])]
)
def test_off_asks_once(answer, sent):
    async def scenario(app, pilot, link):
        await pilot.press("o")
        await until(pilot, lambda: isinstance(app.screen, Confirm))
        await pilot.press(answer)
        await until(pilot, lambda: not isinstance(app.screen, Confirm))
        await until(pilot, lambda: len(link.sent) == len(sent))

    assert run(scenario, supervisor=FakeSupervisor("STANDBY")).sent == sent


def test_off_where_it_means_nothing_is_left_to_the_supervisor_to_refuse():
    async def scenario(app, pilot, link):
        await pilot.press("o")
        await until(pilot, lambda: link.sent)

    assert run(scenario).sent == [Off(loop="right")]


@pytest.mark.parametrize("key", ["s", "space", "ctrl+s"])
@pytest.mark.parametrize("opener", ["v", "e"])
def test_stop_works_from_every_dialog(opener, key):
    async def scenario(app, pilot, link):
        await pilot.press(opener)
        assert app.screen.is_modal
        await pilot.press(key)
        await until(pilot, lambda: link.sent)

    assert run(scenario).sent == [Stop()]


def test_stop_works_from_the_palette_and_s_is_a_letter_there():
    async def scenario(app, pilot, link):
        await pilot.press("ctrl+p")
        await until(pilot, lambda: isinstance(app.screen, CommandPalette))
        await pilot.press("s", "space")
        assert not link.sent
        await pilot.press("ctrl+s")
        await until(pilot, lambda: link.sent)

    assert run(scenario).sent == [Stop()]


def test_other_commands_do_not_reach_through_a_dialog():
    async def scenario(app, pilot, link):
        await pilot.press("e", "a", "o")
        await pilot.press("escape", "h")
        await until(pilot, lambda: link.sent)

    assert run(scenario).sent == [Release(loop="right")]


def test_ctrl_c_quits_even_over_a_dialog():
    async def scenario(app, pilot, link):
        await pilot.press("e", "ctrl+c")
        await until(pilot, lambda: not app.is_running)

    assert run(scenario).closed


def test_a_refused_command_is_told_with_its_reason():
    async def scenario(app, pilot, link):
        await pilot.press("a")
        await until(pilot, lambda: notifications(app))
        assert "Acquire refused: devices are off; press b first" in notifications(app)

    refusal = Reply(accepted=False, text="devices are off; press b first")
    run(scenario, link=FakeLink(lambda _command: refusal), supervisor=FakeSupervisor("OFF"))


def test_loops_are_cycled_and_commands_go_to_the_shown_one():
    async def scenario(app, pilot, link):
        assert "right 1/2" in header_text(app)
        await pilot.press("l")
        assert "left 2/2" in header_text(app)
        await pilot.press("h")
        await until(pilot, lambda: link.sent)

    assert run(scenario, supervisor=FakeSupervisor(loops=("right", "left"))).sent == [
        Release(loop="left")
    ]


async def chosen_in_palette(app, pilot, typed):
    """Type in the palette until one command is left, and take it."""
    await pilot.press("ctrl+p")
    await until(pilot, lambda: isinstance(app.screen, CommandPalette))
    await pilot.press(*("space" if letter == " " else letter for letter in typed))
    await until(pilot, lambda: app.screen.query("OptionList").first().option_count == 1)
    await pilot.press("enter")
    await until(pilot, lambda: not isinstance(app.screen, CommandPalette))


@pytest.mark.long
@pytest.mark.parametrize(
    ("typed", "command"),
    [
        ("target 20 19.5", SetTarget(loop="right", az_px=20.0, el_px=19.5)),
        ("controller lqg-ltr", SetController(loop="right", name="lqg-ltr")),
        ("reset clock", Reset(loop="right", name="clock_step")),
    ],
)
def test_what_has_no_key_is_typed_into_the_palette(typed, command):
    supervisor = FakeSupervisor()
    supervisor.interlocks = [
        TrippedInterlock(
            name="clock_step", since_s=START_S, action="warn", reset="hand", reason="it stepped"
        )
    ]

    async def scenario(app, pilot, link):
        await chosen_in_palette(app, pilot, typed)
        await until(pilot, lambda: link.sent)

    assert run(scenario, supervisor=supervisor).sent == [command]


@pytest.mark.long
@pytest.mark.parametrize(("answer", "sent"), [("y", [Shutdown()]), ("n", []), ("escape", [])])
def test_the_supervisor_is_shut_down_through_the_palette_and_asks_once(answer, sent):
    async def scenario(app, pilot, link):
        await chosen_in_palette(app, pilot, "shut down")
        await until(pilot, lambda: isinstance(app.screen, Confirm))
        assert not link.sent
        await pilot.press(answer)
        await until(pilot, lambda: not isinstance(app.screen, Confirm))
        await until(pilot, lambda: len(link.sent) == len(sent))

    assert run(scenario).sent == sent


def test_who_has_the_instrument_is_in_the_header():
    async def scenario(app, pilot, link):
        assert " by " not in header_text(app)
        message = FakeSupervisor().messages(3)[-1]
        link.deliver([msgspec.structs.replace(message, commander="anna")])
        await until(pilot, lambda: "by anna" in header_text(app))

    run(scenario)


def test_taking_over_is_in_the_palette_and_its_answer_is_shown():
    answer = Reply(accepted=True, text="owner has the instrument, taken over from anna")

    async def scenario(app, pilot, link):
        command = next(c for c in app.get_system_commands(app.screen) if c.title == "Take over")
        command.callback()
        await until(pilot, lambda: "taken over from anna" in notifications(app))

    assert run(scenario, link=FakeLink(lambda _: answer)).sent == [TakeOver()]
