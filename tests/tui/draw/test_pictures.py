"""The focal plane as a picture: what is sent to terminals that draw pixels, and to which."""

import base64
import re
import zlib
from typing import get_args, get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np

from fitctl.commands.operate.console import console
from fitctl.tui.draw.frame import place
from fitctl.tui.draw.overlays import OVERLAY_INKS, SHAPES, Overlay, cell_marks, paint
from fitctl.tui.draw.pictures import KITTY_AWAY, SIXEL_INKS, kitty, sixel
from fitctl.tui.graphics import Graphics, PictureSender, cell_size_px, graphics_of
from fitctl.tui.inks import SKY
from fitctl.tui.widgets import focalplane
from fitctl.tui.widgets.focalplane import FocalPlane
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FixedApp, settle
from tests.tui.piloted import run_app

INKS = [f"#{16 * n:02x}{255 - 16 * n:02x}40" for n in range(SIXEL_INKS)]
CELL_PX = (8, 16)
pictures = st_np.arrays(
    np.uint8,
    st.tuples(st.integers(1, 30), st.integers(1, 30)),
    elements=st.integers(0, SIXEL_INKS - 1),
)


def drawn_sixels(sequence):
    """What a VT340 makes of it; -1 where it draws nothing."""
    width, height, body = re.fullmatch(
        r'\x1bP0;1q"1;1;(\d+);(\d+)(.*)\x1b\\', sequence, re.DOTALL
    ).groups()
    seen = np.full((int(height), int(width)), -1)
    x = top = ink = 0
    for token in re.finditer(r"#(\d+)(;[\d;]+)?|!(\d+)(.)|([$-])|([?-~])", body):
        number, colour, count, repeated, control, single = token.groups()
        if number:
            ink = ink if colour else int(number)
        elif control:
            x, top = 0, top + 6 * (control == "-")
        else:
            bits, run = ord(repeated or single) - 63, int(count or 1)
            for low in range(6):
                if bits >> low & 1:
                    seen[top + low, x : x + run] = ink
            x += run
    return seen


@given(picture=pictures)
def test_sixels_draw_every_pixel_in_its_ink(picture):
    assert (drawn_sixels(sixel(picture, INKS)) == picture).all()


@given(picture=pictures)
def test_kitty_is_sent_every_pixel_in_chunks_that_it_takes(picture):
    sequence = kitty(np.tile(picture, (9, 9)), INKS, 4, 2)
    messages = re.findall(r"\x1b_G([^;]*);([^\x1b]*)\x1b\\", sequence)
    assert all(len(data) <= 4096 for _, data in messages)
    assert [("m=1" in keys) for keys, _ in messages] == [True] * (len(messages) - 1) + [False]
    height, width = 9 * picture.shape[0], 9 * picture.shape[1]
    assert f"s={width},v={height}" in messages[0][0]
    raw = zlib.decompress(base64.b64decode("".join(data for _, data in messages)))
    seen = np.frombuffer(raw, np.uint8).reshape(height, width, 3)
    assert (seen[..., 0] == 16 * np.tile(picture, (9, 9))).all()


@pytest.mark.parametrize(
    ("wanted", "environment", "used"),
    [
        (Graphics.AUTO, {"TERM": "xterm-kitty"}, Graphics.KITTY),
        (Graphics.AUTO, {"TERM": "mlterm-256color"}, Graphics.SIXEL),
        (Graphics.AUTO, {"TERM": "tmux-256color", "KITTY_WINDOW_ID": "1"}, Graphics.HALF_BLOCKS),
        (Graphics.AUTO, {"TERM": "xterm-256color"}, Graphics.HALF_BLOCKS),
        (Graphics.AUTO, {}, Graphics.HALF_BLOCKS),
        (Graphics.AUTO, {"TERM": "xterm-kitty", "NO_COLOR": "1"}, Graphics.HALF_BLOCKS),
        (Graphics.SIXEL, {"TERM": "xterm-256color"}, Graphics.SIXEL),
        (Graphics.HALF_BLOCKS, {"TERM": "xterm-kitty"}, Graphics.HALF_BLOCKS),
    ],
)
def test_a_terminal_gets_what_it_is_known_to_have_or_what_is_asked_for(wanted, environment, used):
    assert graphics_of(wanted, environment) is used


def test_the_command_line_offers_all_ways_and_no_others():
    option = get_type_hints(console)["graphics"]
    assert set(get_args(option)) == set(Graphics)


def test_what_is_no_terminal_has_no_cells(tmp_path):
    with (tmp_path / "file").open("w") as file:
        assert cell_size_px(file.fileno()) is None


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("at_px", [(24.0, 19.5), (3.0, 35.0)])
def test_an_overlay_is_in_the_same_place_as_characters_and_as_pixels(shape, at_px):
    placing = place(40, 40, 40, 20)
    overlay = Overlay(shape, *at_px, SKY)
    picture = np.zeros((20 * CELL_PX[1], 40 * CELL_PX[0]), np.uint8)
    inks = ["#000000", *OVERLAY_INKS]
    paint([overlay], picture, placing, inks)
    row, column = np.nonzero(picture == inks.index(SKY))
    cells = np.array([cell for cell in cell_marks([overlay], placing) if cell[0] >= 0])
    middle = (
        (column.min() + column.max()) / 2 / CELL_PX[0],
        (row.min() + row.max()) / 2 / CELL_PX[1],
    )
    assert len(row)
    if at_px == (24.0, 19.5):  # not cut by the edge
        of_cells = (cells.min(axis=0) + cells.max(axis=0) + 1) / 2
        assert middle == pytest.approx(tuple(of_cells), abs=1.0)


# ---------------------------------------------------------------- on the screen


@pytest.fixture
def pictured(monkeypatch):
    """A console on a terminal that draws pixels, and what is sent to it beside text."""
    monkeypatch.setattr(focalplane, "cell_size_px", lambda _terminal: CELL_PX)
    monkeypatch.setattr(focalplane, "PICTURE_BEATS", 1)

    def make(kind, supervisor=None):
        sent = []
        app = FixedApp(supervisor or FakeSupervisor())
        app.pictures = PictureSender(kind, sent.append)
        return app, sent

    return make


def characters(app):
    plane = app.view.query_one(FocalPlane)
    return "".join(plane.render_line(y).text for y in range(plane.size.height))


@pytest.mark.long
@pytest.mark.parametrize("kind", [Graphics.SIXEL, Graphics.KITTY])
@pytest.mark.parametrize("size", [(80, 24), (120, 40)])
def test_the_frame_is_a_picture_and_its_caption_is_text(pictured, kind, size):
    app, sent = pictured(kind)

    async def scenario(pilot):
        await settle(app, pilot)
        region = app.view.query_one(FocalPlane).content_region
        assert sent[-1].startswith(f"\x1b7\x1b[{region.y + 1};{region.x + 1}H\x1b")
        assert sent[-1].endswith("\x1b8")
        assert "▀" not in characters(app)
        assert "star" in characters(app)

    run_app(app, scenario, size=size)


def test_sixels_stay_within_the_rows_above_the_caption(pictured):
    app, sent = pictured(Graphics.SIXEL)

    async def scenario(pilot):
        await settle(app, pilot)
        rows = app.view.query_one(FocalPlane).content_size.height
        height_px = int(re.search(r'"1;1;\d+;(\d+)', sent[-1])[1])
        assert height_px <= (rows - 1) * CELL_PX[1]

    run_app(app, scenario, size=(80, 24))


@pytest.mark.long
@pytest.mark.parametrize(
    "cover",
    [
        lambda app: app.action_events(),
        lambda app: app.notify("STOP not confirmed"),
        lambda app: app.action_view("devices"),
    ],
    ids=["dialog", "toast", "screen"],
)
def test_nothing_is_hidden_by_a_picture(pictured, cover):
    app, sent = pictured(Graphics.KITTY)

    async def scenario(pilot):
        await settle(app, pilot)
        assert sent[-1] != KITTY_AWAY
        cover(app)
        await settle(app, pilot)
        assert sent[-1] == KITTY_AWAY
        before = len(sent)
        await settle(app, pilot)
        assert len(sent) == before

    run_app(app, scenario)


@pytest.mark.long
def test_old_data_are_no_picture_for_they_must_look_old(pictured):
    app, sent = pictured(Graphics.SIXEL)

    async def scenario(pilot):
        await settle(app, pilot)
        app.state.received_s -= 5.0
        before = len(sent)
        await settle(app, pilot)
        assert len(sent) == before
        assert "▀" in characters(app)

    run_app(app, scenario)


def test_a_terminal_that_does_not_tell_its_pixels_gets_half_blocks(pictured, monkeypatch):
    app, sent = pictured(Graphics.SIXEL)
    monkeypatch.setattr(focalplane, "cell_size_px", lambda _terminal: None)

    async def scenario(pilot):
        await settle(app, pilot)
        assert not sent
        assert "▀" in characters(app)

    run_app(app, scenario)
