"""Texts from people, logs and devices where Textual takes markup."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from textual.command import CommandPalette
from textual.content import Content
from textual.widgets import Input

from fitctl.tui.dialogs import Ask, Running
from fitctl.tui.look import as_markup
from fitctl.tui.widgets.readings import Detail
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.live import until
from tests.tui.piloted import pressed, run
from tests.tui.test_alarms import tripped

HOSTILE = ["[/", "x [/bold] y", "[$x]", "[@click=app.quit]here[/]", "a\\", "\\[b]"]


@given(st.text(st.sampled_from("[]/\\$@#=()'\" ab1,:"), max_size=25))
def test_a_text_as_markup_is_shown_as_it_is(content):
    assert Content.from_markup(as_markup(content)).plain == content


@pytest.mark.parametrize("typed", HOSTILE)
def test_a_command_to_rehearse_is_the_title_as_it_was_typed(typed):
    async def scenario(app, pilot):
        await pressed(app, pilot, "d")
        assert isinstance(app.screen, Ask)
        app.screen.query_one(Input).value = f"target 22 {typed}"
        await pressed(app, pilot, "enter")
        assert isinstance(app.screen, Running)
        title = app.screen.query_one("VerticalScroll")._border_title.plain
        assert title == f"Rehearse target 22 {typed}"

    run(scenario)


@pytest.mark.parametrize("name", HOSTILE)
def test_an_interlock_is_in_the_palette_and_among_the_readings_by_its_name(name):
    supervisor = FakeSupervisor()
    supervisor.interlocks = [msgspec.structs.replace(tripped(name), reason=name)]

    async def scenario(app, pilot):
        await pressed(app, pilot, "ctrl+p", *"reset")
        await until(pilot, lambda: isinstance(app.screen, CommandPalette))
        rows = app.screen.query("OptionList").first()
        await until(pilot, lambda: rows.option_count >= 1)
        prompts = [rows.get_option_at_index(n).prompt.plain for n in range(rows.option_count)]
        assert f"reset {name}\n{name}" in prompts

    run(scenario, supervisor=supervisor)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_device_of_any_name_is_the_title_of_its_details(name):
    supervisor = FakeSupervisor()

    async def scenario(app, pilot):
        await pressed(app, pilot, "2")
        detail = app.view.query_one(Detail)
        device = detail._devices.now()
        detail._devices.now = lambda: msgspec.structs.replace(device, device=name)
        detail.draw(80, 12)
        assert detail._border_title.plain == name

    run(scenario, supervisor=supervisor)
