"""Colours of the console and of the report: all can be read, and each mode has its own."""

import pytest

from fitctl.messages.modes import Mode
from fitctl.tui import inks

READABLE = 4.5
PLAIN_GRAPHICS = 3.0  # WCAG 2.1, 1.4.11: what is no text
WORDS = {name for name in vars(inks) if name.isupper()} - {
    "PAPER",
    "SHEET",
    "FAINT",
    "FAULT",
    "MODE_COLOURS",
}


def luminance(colour):
    """Relative luminance as WCAG 2.1 defines it."""
    channels = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    red, green, blue = (
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one, other):
    """Contrast ratio of two colours, 1 to 21, as WCAG 2.1 defines it."""
    dark, bright = sorted((luminance(one), luminance(other)))
    return (bright + 0.05) / (dark + 0.05)


def test_contrast_is_that_of_wcag():
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)


@pytest.mark.parametrize("ground", [inks.PAPER, inks.SHEET])
@pytest.mark.parametrize("name", sorted(WORDS))
def test_every_ink_can_be_read_on_every_ground(name, ground):
    assert contrast(getattr(inks, name), ground) >= READABLE


@pytest.mark.parametrize("mode", [*inks.MODE_COLOURS, "FAULT"])
def test_the_colour_of_a_mode_can_be_read_and_its_bar_shows_on_white_paper(mode):
    colour = inks.FAULT if mode == "FAULT" else inks.MODE_COLOURS[mode]
    assert contrast(colour.dark, inks.PAPER) >= READABLE
    assert contrast(colour.light, "#ffffff") >= PLAIN_GRAPHICS


def test_every_mode_has_a_colour_of_its_own_that_is_not_of_what_is_abnormal():
    assert set(inks.MODE_COLOURS) == {mode.name for mode in Mode}
    distinct = {name: colour for name, colour in inks.MODE_COLOURS.items() if name != "LOCKED"}
    for side in ("dark", "light"):
        colours = [getattr(colour, side) for colour in distinct.values()]
        assert len(set(colours)) == len(colours)
        assert not {inks.RED, inks.ORANGE, getattr(inks.FAULT, side)} & set(colours)
