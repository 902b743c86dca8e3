import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.tui.draw import frame
from fitctl.tui.draw.colours import ANCHORS, colour_map
from fitctl.tui.look import width
from tests.instruments.fake_supervisor import spot_image

INFERNO = colour_map("inferno")


def image(star=(24.0, 19.5)):
    return spot_image(np.random.default_rng(1), [(*star, 28000.0)])


def test_forty_by_forty_pixels_take_forty_by_twenty_cells():
    placing = frame.place(40, 40, 40, 20)
    assert (placing.zoom, placing.columns, placing.rows) == (1, 40, 20)
    assert (placing.left, placing.top) == (0, 0)


def test_the_zoom_is_whole_and_the_picture_in_the_middle():
    placing = frame.place(40, 40, 130, 47)
    assert (placing.zoom, placing.columns, placing.rows) == (2, 80, 40)
    assert (placing.left, placing.top) == (25, 3)


@given(
    width_px=st.integers(8, 700),
    height_px=st.integers(8, 700),
    columns=st.integers(1, 200),
    rows=st.integers(1, 60),
)
def test_every_frame_fits_every_panel(width_px, height_px, columns, rows):
    placing = frame.place(width_px, height_px, columns, rows)
    picture = np.full((height_px, width_px), 1000, dtype=np.uint16)
    levels = frame.levels_on_screen(picture, placing)
    assert levels.shape == (2 * placing.rows, placing.columns)
    lines = frame.frame_lines(levels, placing, {}, columns, rows, INFERNO)
    assert len(lines) == rows
    assert all(width(line) <= columns for line in lines)


def test_the_star_is_the_brightest_and_the_field_is_mostly_black():
    levels = frame.stretch(image())
    brightest = np.unravel_index(levels.argmax(), levels.shape)
    assert brightest in {(19, 24), (20, 24)}
    assert levels.max() == frame.LEVELS - 1
    assert np.mean(levels == 0) > 0.7


def test_noise_alone_is_never_bright():
    levels = frame.stretch(spot_image(np.random.default_rng(1), []))
    assert levels.max() < frame.LEVELS // 2


def test_a_flat_frame_is_black():
    assert frame.stretch(np.full((40, 40), 4095, dtype=np.uint16)).max() == 0


def test_elevation_points_up():
    placing = frame.place(40, 40, 40, 20)
    levels = frame.levels_on_screen(image(star=(5.0, 38.0)), placing)
    row, column = np.unravel_index(levels.argmax(), levels.shape)
    assert (row, column) == (1, 5)
    assert (int(placing.column(5.0)), int(placing.row(38.0))) == (5, 0)


def test_a_star_survives_shrinking():
    picture = np.full((480, 640), 1000, dtype=np.uint16)
    picture[100, 100] = 60000
    placing = frame.place(640, 480, 40, 20)
    levels = frame.levels_on_screen(picture, placing)
    row, column = np.unravel_index(levels.argmax(), levels.shape)
    assert levels.max() == frame.LEVELS - 1
    assert column == 100 // placing.shrink
    assert abs(placing.row(100.0) - placing.top - row / 2) <= 1


def test_equal_neighbours_share_a_segment():
    placing = frame.place(40, 40, 40, 20)
    levels = np.zeros((40, 40), dtype=np.int64)
    lines = frame.frame_lines(levels, placing, {}, 40, 20, INFERNO)
    assert all(len(line) == 1 for line in lines)


def test_a_mark_takes_one_cell_and_contrasts():
    placing = frame.place(40, 40, 40, 20)
    levels = np.zeros((40, 40), dtype=np.int64)
    levels[20:22] = frame.LEVELS - 1
    marks = {(7, 10): frame.Mark("+"), (7, 3): frame.Mark("+")}
    lines = frame.frame_lines(levels, placing, marks, 40, 20, INFERNO)

    def mark_style(line):
        return next(segment.style for segment in line if segment.text == "+")

    assert mark_style(lines[10]).color.name == INFERNO[0]
    assert mark_style(lines[3]).color.name == "#ffffff"
    assert width(lines[10]) == 40


@pytest.mark.parametrize(("row", "character"), [(10.0, "▔"), (10.5, "─"), (10.9, "▁")])
def test_the_reticle_shows_where_in_its_row_the_target_is(row, character):
    marks = frame.reticle_marks(24.5, row, (5, 3), "#ffffff")
    assert marks[29, 10].character == character
    assert marks[19, 10].character == character
    assert (24, 10) not in marks


def test_the_box_is_closed():
    marks = frame.box_marks(2, 3, 10, 8, "#ffffff")
    assert len(marks) == 2 * (9 + 6) - 4
    assert marks[2, 3].character == "┌"
    assert marks[10, 8].character == "┘"


@pytest.mark.parametrize("name", ANCHORS)
def test_lightness_grows_from_dark_to_bright(name):
    channels = [[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colour_map(name)]
    lightness = np.array(channels) @ [0.2126, 0.7152, 0.0722]
    assert len(lightness) == frame.LEVELS
    assert np.all(np.diff(lightness) > 0)


@pytest.mark.parametrize("name", ["inferno", "viridis", "cividis"])
def test_the_maps_are_those_of_matplotlib(name):
    theirs = mpl.colormaps[name](np.linspace(0, 1, frame.LEVELS))[:, :3] * 255
    ours = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colour_map(name)])
    assert np.abs(ours - theirs).max() < 12


@pytest.mark.parametrize("kind", frame.STRETCHES)
def test_every_stretch_keeps_the_order_of_pixels_and_uses_all_levels(kind):
    picture = image()
    levels = frame.stretch(picture, kind)
    order = np.argsort(picture, axis=None)
    assert np.all(np.diff(levels.ravel()[order]) >= 0)
    assert (levels.min(), levels.max()) == (0, frame.LEVELS - 1)


@given(
    az_px=st.integers(0, 39),
    el_px=st.integers(0, 39),
    size=st.sampled_from([(40, 20), (80, 40), (130, 47), (30, 11)]),
)
def test_a_click_is_read_as_the_pixel_that_is_drawn_there(az_px, el_px, size):
    placing = frame.place(40, 40, *size)
    column, row = int(placing.column(az_px)), int(placing.row(el_px))
    az, el = placing.pixel(column, row)
    assert abs(az - az_px) <= placing.shrink / 2 + 0.5
    assert abs(el - el_px) <= placing.shrink + 0.5
