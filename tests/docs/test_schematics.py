"""The schematics in the documents are those that their code draws; the moving picture is small, and moves."""

import getpass
import importlib
import io
import re
import socket
import sys
from xml.etree import ElementTree as ET

import pytest
from documents import DOCUMENTS, ROOT
from PIL import Image
from rich.console import Console

from fitctl.identify.drawing import for_dark_pages

PICTURES = ROOT / "docs" / "pictures"
SVG = "{http://www.w3.org/2000/svg}"
CHARACTER_PX = 7.5  # of 14 px sans-serif, a wide one


@pytest.fixture(scope="module", autouse=True)
def scripts_find_each_other():
    sys.path.insert(0, str(PICTURES))
    yield
    sys.path.remove(str(PICTURES))


@pytest.fixture(scope="module")
def draw():
    """The script that draws all schematics."""
    return importlib.import_module("draw")


@pytest.fixture(scope="module")
def take_moving():
    """The script that records the console."""
    return importlib.import_module("take_moving")


def test_every_schematic_is_what_its_code_draws(draw):
    for name, drawn in draw.DRAWN.items():
        assert (PICTURES / name).read_text() == drawn(), f"{name}: make pictures"


def test_every_schematic_has_a_label_and_words_that_fit_their_boxes(draw):
    for name in draw.DRAWN:
        root = ET.parse(PICTURES / name).getroot()
        assert root.get("aria-label"), name
        for element in root:
            if element.tag == f"{SVG}rect":
                room_px = float(element.get("width"))
            elif element.tag == f"{SVG}text" and not element.get("class"):
                assert len(element.text) * CHARACTER_PX <= room_px, (name, element.text)


def test_every_schematic_is_in_a_document(draw):
    shown = "".join(document.read_text() for document in DOCUMENTS)

    for name in (*draw.DRAWN, "console-moving.gif"):
        assert f"pictures/{name})" in shown, name


def test_the_moving_picture_has_many_frames_and_is_small(take_moving):
    path = PICTURES / "console-moving.gif"

    assert path.stat().st_size < take_moving.MOST_BYTES
    with Image.open(path) as picture:
        assert picture.n_frames > 30
        assert picture.width == take_moving.WIDTH_PX


def test_frames_become_a_picture_that_moves_and_keeps_their_colours(take_moving, tmp_path):
    colours = [(200, 30, 40), (20, 180, 60), (30, 40, 220)]

    frames = [Image.new("RGB", (40, 20), colour) for colour in colours]
    take_moving.write_moving(frames, [0.25, 0.311, 3.0], tmp_path / "x.gif")

    with Image.open(tmp_path / "x.gif") as picture:
        assert picture.n_frames == 3
        for number, colour in enumerate(colours):
            picture.seek(number)
            assert picture.convert("RGB").getpixel((5, 5)) == pytest.approx(colour, abs=4)
            assert picture.info["duration"] == (250, 310, 3000)[number]


def test_a_console_is_shown_without_a_font_from_elsewhere_and_the_name_of_its_taker(
    take_moving,
):
    me = f"{getpass.getuser()}@{socket.gethostname()}"
    console = Console(record=True, file=io.StringIO(), width=60)
    console.print(f"by {me}")
    shown = console.export_svg()
    assert "@font-face" in shown
    assert me in shown

    mended = take_moving.for_everybody(shown)

    assert "@font-face" not in mended
    assert me not in mended
    assert take_moving.height(mended) == take_moving.height(shown)


def test_the_pictures_of_consoles_have_no_font_from_elsewhere_and_no_name_of_a_machine():
    pictures = list(PICTURES.glob("console*.svg"))

    assert len(pictures) > 7
    for path in pictures:
        shown = path.read_text()
        assert "@font-face" not in shown, path.name
        assert not re.search(r"by&#160;\w+@", shown), path.name


def test_every_plot_has_colours_for_a_dark_page_too():
    plots = [*(PICTURES / "theory").glob("*.svg"), PICTURES / "learning-6hz.svg"]

    assert len(plots) > 8
    for path in plots:
        text = path.read_text()
        assert text == for_dark_pages(text), f"{path.name}: written without for_dark_pages"
