"""Which way a terminal shows pictures, and sending them to it beside what Textual sends.

Nothing is asked of the terminal: one that does not answer would hold the console up, and one that answers late
would type into it. So `auto` goes by what the environment says of the terminal, and that goes by name.
"""

from __future__ import annotations

import fcntl
import struct
import termios
from collections.abc import Callable, Mapping
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fitctl.tui.draw.pictures import KITTY_AWAY, SIXEL_INKS, kitty, sixel


class Graphics(StrEnum):
    """How the focal plane is drawn."""

    AUTO = "auto"
    HALF_BLOCKS = "half-blocks"
    SIXEL = "sixel"
    KITTY = "kitty"


# What TERM begins with, of terminals in which it was seen to work. Inside tmux and screen TERM is theirs, and
# neither passes pictures on.
_TERMINALS = {
    "xterm-kitty": Graphics.KITTY,
    "mlterm": Graphics.SIXEL,
}


def graphics_of(wanted: Graphics, environment: Mapping[str, str]) -> Graphics:
    """What to use: as wanted, or, for `auto`, what the terminal is known to have."""
    if wanted is not Graphics.AUTO:
        return wanted
    if "NO_COLOR" in environment:
        return Graphics.HALF_BLOCKS
    term = environment.get("TERM", "")
    known = (how for name, how in _TERMINALS.items() if term.startswith(name))
    return next(known, Graphics.HALF_BLOCKS)


def cell_size_px(terminal: int) -> tuple[int, int] | None:
    """Width and height of a character cell; None where the terminal does not report it."""
    try:
        size = fcntl.ioctl(terminal, termios.TIOCGWINSZ, bytes(8))
    except OSError:
        return None
    rows, columns, width_px, height_px = struct.unpack("4H", size)
    if not (rows and columns and width_px >= columns and height_px >= rows):
        return None
    return width_px // columns, height_px // rows


class PictureSender:
    """Puts pictures on the terminal, and takes them away.

    Parameters
    ----------
    graphics : Graphics
        Not `auto`.
    write : callable
        Takes what goes to the terminal, in its turn among what Textual sends.
    """

    def __init__(self, graphics: Graphics, write: Callable[[str], object]) -> None:
        self.most_inks = SIXEL_INKS if graphics is Graphics.SIXEL else 256
        self._graphics = graphics
        self._write = write
        self._shown = False

    def show(
        self,
        picture: NDArray[np.uint8],
        inks: list[str],
        at: tuple[int, int],
        cells: tuple[int, int],
    ) -> None:
        """Draw a picture of inks, shape (height, width), from a column and row on, over so many of them."""
        drawn = (
            sixel(picture, inks)
            if self._graphics is Graphics.SIXEL
            else kitty(picture, inks, *cells)
        )
        column, row = at
        self._shown = True
        self._write(f"\x1b7\x1b[{row + 1};{column + 1}H{drawn}\x1b8")

    def clear(self) -> None:
        """Make room for characters; over sixels they lie anyway."""
        if self._shown and self._graphics is Graphics.KITTY:
            self._write(KITTY_AWAY)
        self._shown = False
