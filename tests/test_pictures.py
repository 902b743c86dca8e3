"""The schematics in the documents are those that their code draws."""

import importlib
import sys
from xml.etree import ElementTree as ET

import pytest
from documents import DOCUMENTS, ROOT

PICTURES = ROOT / "docs" / "pictures"
SVG = "{http://www.w3.org/2000/svg}"
CHARACTER_PX = 7.5  # of 14 px sans-serif, a wide one


@pytest.fixture(scope="module")
def draw():
    """The scripts that make pictures, which find each other where they are."""
    sys.path.insert(0, str(PICTURES))
    yield importlib.import_module("draw")
    sys.path.remove(str(PICTURES))


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

    for name in draw.DRAWN:
        assert f"pictures/{name})" in shown, name
