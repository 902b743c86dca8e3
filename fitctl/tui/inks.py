"""The colours of words, signs and lines, and one colour for each mode, which the report shares.

Red and orange are for what is abnormal, and for nothing else but the STOP key. Wherever a colour means
something, a symbol or a word beside it means the same. All inks reach a contrast of 4.5:1 on `PAPER` and
on `SHEET`; `FAINT` is for lines and grounds, never for words.
"""

from __future__ import annotations

from typing import NamedTuple

PAPER = "#0b0e13"
SHEET = "#11161d"  # the ground of a dialog
FAINT = "#39424e"
INK = "#d7dde5"
DIM = "#8b96a4"
WHITE = "#ffffff"
SKY = "#56b4e9"
GREEN = "#2fbf8f"
YELLOW = "#f0e442"
VIOLET = "#a99cf5"
PINK = "#e39ac4"
ORANGE = "#e69f00"  # a warning
RED = "#ff6b4a"  # an error, and the STOP key

AZ, EL = SKY, YELLOW


class OnBoth(NamedTuple):
    """One colour as it is on a dark ground and on white paper."""

    dark: str
    light: str


MODE_COLOURS = {
    "OFF": OnBoth("#9aa4b0", "#7b8590"),
    "STANDBY": OnBoth(SKY, "#2f7fb8"),
    "ACQUISITION": OnBoth(YELLOW, "#9c8500"),
    "COARSE": OnBoth(VIOLET, "#7a63c9"),
    "VERNIER": OnBoth(GREEN, "#00805c"),
    "LOCKED": OnBoth(GREEN, "#00805c"),
    "SAFE": OnBoth(WHITE, "#20262e"),
    "EXPERIMENT": OnBoth(PINK, "#b0588c"),
}
"""Of the modes by name, on the console and in the report. SAFE after a fault is `FAULT` instead."""
FAULT = OnBoth(RED, "#b3261e")
