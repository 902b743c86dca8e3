"""Everything that can be read on any snapshot has a contrast of 4.5:1, and STOP is on all of them."""

import html
import re
from pathlib import Path

import pytest

from fitctl.tui.inks import SHEET
from fitctl.tui.look import has_words
from tests.tui.test_inks import READABLE, contrast

SNAPSHOTS = sorted(Path(__file__).with_name("__snapshots__").rglob("*.svg"))
ROW_PX = 24.4  # of Rich's export
STYLE = re.compile(r"\.(terminal-[\w-]*r\d+) \{ fill: (#[0-9a-f]{6})")
RECT = re.compile(
    r'<rect fill="(#[0-9a-f]{6})" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"'
)
TEXT = re.compile(
    r'<text class="(terminal-[\w-]*r\d+)" x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]*)</text>'
)
MARKS = {"+", "◦", "╳"}  # on the camera's frame: lines of a drawing


def written(svg):
    """Row, text, colour and ground of everything that is written."""
    inks = dict(STYLE.findall(svg))
    grounds = {}
    for colour, *numbers in RECT.findall(svg):
        x, y, width, _ = map(float, numbers)
        grounds.setdefault(round((y - 1.5) / ROW_PX), []).append((x, x + width, colour))
    for style, x, y, escaped in TEXT.findall(svg):
        content = html.unescape(escaped).replace("\xa0", " ")
        row, at = round((float(y) - 20.0) / ROW_PX), float(x) + 1.0
        on = [colour for left, right, colour in grounds.get(row, []) if left <= at < right]
        if style in inks and on:
            yield row, content, inks[style], on[-1]


@pytest.mark.parametrize("path", SNAPSHOTS, ids=lambda path: path.stem)
def test_all_words_can_be_read_and_stop_is_at_the_top_right(path):
    parts = list(written(path.read_text()))
    # What lies under a dialog is veiled; of such a snapshot only the dialog is read.
    has_dialog = any(ground == SHEET for *_, ground in parts)
    words = [
        (text, ink, ground)
        for _, text, ink, ground in parts
        if has_words(text)
        and not set(text.strip()) <= MARKS
        and (ground == SHEET or not has_dialog)
    ]
    assert len(words) >= 3
    assert [word for word in words if contrast(word[1], word[2]) < READABLE] == []
    grounds = [ground for row, text, _, ground in parts if row == 0 and text == "  s STOP  "]
    assert grounds in (["#ff6b4a"], ["#ffffff"])
