"""The Operate screen: target, window and stages by hand, and how the picture looks."""

import msgspec
import pytest

from fitctl.messages.commands import Jog, Look, SetBiasOffset, SetTarget
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.hand import Hand
from fitctl.tui.widgets.keys import Keys
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import settle
from tests.tui.piloted import pressed, run, sent


@pytest.mark.long
def test_a_target_is_put_with_the_cursor_and_confirmed():
    async def scenario(app, pilot):
        await pressed(app, pilot, "t", "right", "right", "up")
        assert app.view.query_one(FocalPlane).cursor_px == (25.0, 20.0)
        assert "Set target" in app.view.query_one(Keys).render_line(0).text
        assert not sent(app)
        await pressed(app, pilot, "enter")

    assert sent(run(scenario)) == [SetTarget(loop="right", az_px=25.0, el_px=20.0)]


@pytest.mark.long
def test_a_click_puts_the_cursor_and_moves_nothing_by_itself():
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await settle(app, pilot)
        assert app.view.query_one(FocalPlane).cursor_px == (10.0, 28.5)
        assert not sent(app)
        await pressed(app, pilot, "escape", "enter")

    assert sent(run(scenario)) == []


@pytest.mark.long
def test_the_window_is_put_on_another_star_with_the_same_cursor():
    async def scenario(app, pilot):
        await pressed(app, pilot, "i", "left", "left", "down")
        assert app.view.query_one(FocalPlane).cursor_px == (23.0, 19.0)
        assert "Look here" in app.view.query_one(Keys).render_line(0).text
        assert not sent(app)
        await pressed(app, pilot, "i")
        assert app.view.query_one(FocalPlane).cursor_px is None

    assert sent(run(scenario)) == [Look(loop="right", az_px=23.0, el_px=19.0)]


@pytest.mark.long
def test_the_mouse_alone_puts_the_window_on_another_star():
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await settle(app, pilot)
        line = app.view.query_one(Keys).render_line(0).text
        await pilot.click(Keys, offset=(line.index("Look here"), 0))
        await settle(app, pilot)

    assert sent(run(scenario)) == [Look(loop="right", az_px=10.0, el_px=28.5)]


@pytest.mark.long
def test_the_cursor_stays_on_the_frame():
    async def scenario(app, pilot):
        await pressed(app, pilot, "t", *["left"] * 50)
        assert app.view.query_one(FocalPlane).cursor_px == (0.0, 19.5)

    run(scenario)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["OFF", "STANDBY", "ACQUISITION", "SAFE"])
def test_no_target_is_put_without_a_star(mode):
    async def scenario(app, pilot):
        await pilot.click(FocalPlane, offset=(10, 6))
        await pressed(app, pilot, "t", "enter")
        assert app.view.query_one(FocalPlane).cursor_px is None

    assert sent(run(scenario, mode)) == []


@pytest.mark.parametrize(
    "mode",
    [
        "OFF",
        "VERNIER",
        "SAFE",
        *(
            pytest.param(mode, marks=pytest.mark.long)
            for mode in ("STANDBY", "ACQUISITION", "COARSE")
        ),
    ],
)
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


@pytest.mark.long
def test_the_mirror_is_put_off_its_bias_and_back():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j", "tab", "left")
        assert "JOG mirror" in app.view.query_one(Hand).render_line(0).text
        await pressed(app, pilot, "0")

    assert sent(run(scenario, "STANDBY")) == [
        SetBiasOffset(loop="right", az_urad=-5.0, el_urad=0.0),
        SetBiasOffset(loop="right", az_urad=0.0, el_urad=0.0),
    ]


@pytest.mark.long
def test_a_mode_that_allows_no_jog_takes_the_stage_out_of_the_operators_hand():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j")
        stopped = FakeSupervisor("SAFE")
        app.state.accept(stopped.message(), app.clock())
        await settle(app, pilot)
        assert app.view.hand == ""
        await pressed(app, pilot, "right")

    assert sent(run(scenario, "STANDBY")) == []


@pytest.mark.long
def test_nothing_is_jogged_by_old_data():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j")
        app.fixed_s += 5.0
        await settle(app, pilot)
        await pressed(app, pilot, "right")

    assert sent(run(scenario, "STANDBY")) == []


@pytest.mark.long
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


async def clicked(app, pilot, shown):
    """Click what the footer shows."""
    footer = app.view.query_one(Keys).render_line(0).text
    await pilot.click("#keys", offset=(footer.index(shown), 0))
    await settle(app, pilot)


@pytest.mark.long
def test_arrows_and_steps_in_the_footer_are_buttons():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j")
        await clicked(app, pilot, "]")
        await clicked(app, pilot, "←")
        await clicked(app, pilot, "[")
        await clicked(app, pilot, "↑")

    assert sent(run(scenario, "STANDBY")) == [
        Jog(loop="right", az_sky_arcsec=-10.0, el_sky_arcsec=0.0),
        Jog(loop="right", az_sky_arcsec=0.0, el_sky_arcsec=2.0),
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("mode", "keys", "there", "missing"),
    [
        ("VERNIER", ["j"], ["Jog", "Step", "Leave"], ["Stage", "Zero offset"]),
        ("STANDBY", ["j"], ["Jog", "Step", "Stage", "Leave"], ["Zero offset"]),
        ("STANDBY", ["j", "tab"], ["Jog", "Step", "Stage", "Zero offset", "Leave"], []),
    ],
)
def test_a_jog_offers_only_what_it_can_do(mode, keys, there, missing):
    async def scenario(app, pilot):
        await pressed(app, pilot, *keys)
        footer = app.view.query_one(Keys).render_line(0).text
        assert all(label in footer for label in there)
        assert not any(label in footer for label in missing)

    run(scenario, mode)


def test_zero_moves_nothing_while_another_stage_is_in_the_hand():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j", "0")

    assert sent(run(scenario, "STANDBY")) == []


def test_a_metrology_loop_has_a_siderostat_to_jog_and_no_target():
    async def scenario(app, pilot):
        await pressed(app, pilot, "j", "tab", "right", "escape", "t")
        assert app.view.query_one(FocalPlane).cursor_px is None

    supervisor = FakeSupervisor("STANDBY", loops=("metrology",))
    assert sent(run(scenario, supervisor=supervisor)) == [
        Jog(loop="metrology", az_sky_arcsec=2.0, el_sky_arcsec=0.0)
    ]


def test_the_last_frame_says_how_old_it_is_once_the_camera_is_closed():
    async def scenario(app, pilot):
        message = FakeSupervisor("OFF").message()
        before = app.state.newest
        later = msgspec.structs.replace(
            message, frame=before.frame, time_s=before.time_s + 12.0, sequence=before.sequence + 1
        )
        app.fixed_s += 12.0
        app.state.accept(later, app.clock())
        await settle(app, pilot)
        plane = app.view.query_one(FocalPlane)
        caption = "\n".join(plane.render_line(y).text for y in range(plane.size.height))
        assert "last frame 12 s ago" in caption

    run(scenario)
