"""A picture of few inks for terminals that draw pixels: as sixels, or by Kitty's graphics protocol.

Sixel: DEC STD 070, chapter 9. Kitty: https://sw.kovidgoyal.net/kitty/graphics-protocol/.
"""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SIXEL_INKS = 16  # colour registers of a VT340, which xterm imitates to the letter
# This console's only picture: each one sent takes the place of the one before.
KITTY_IMAGE = 0x464954
_CHUNK = 4096
_RUN = re.compile(r"(.)\1{3,254}", re.DOTALL)
_BAND_PX = 6

Inks = NDArray[np.uint8]


def sixel(picture: Inks, inks: Sequence[str]) -> str:
    """The escape sequence that draws a picture at the cursor.

    Parameters
    ----------
    picture : array of uint8, shape (height, width)
        Numbers of inks.
    inks : sequence of str
        At most `SIXEL_INKS`, as ``#rrggbb``.
    """
    height, width = picture.shape
    parts = [f'\x1bP0;1q"1;1;{width};{height}']
    for number in np.unique(picture).tolist():
        red, green, blue = (round(100 * part / 255) for part in _rgb(inks[number]))
        parts.append(f"#{number};2;{red};{green};{blue}")
    bands = []
    for top in range(0, height, _BAND_PX):
        band = picture[top : top + _BAND_PX]
        weights = 1 << np.arange(len(band))
        rows = []
        for number in np.unique(band).tolist():
            codes = (63 + weights @ (band == number)).astype(np.uint8).tobytes().decode("ascii")
            rows.append(f"#{number}{_RUN.sub(_repeated, codes)}")
        bands.append("$".join(rows))
    return "".join([*parts, "-".join(bands), "\x1b\\"])


def kitty(picture: Inks, inks: Sequence[str], columns: int, rows: int) -> str:
    """The escape sequence that puts a picture at the cursor, over so many cells; parameters as of `sixel`."""
    height, width = picture.shape
    table = np.array([list(_rgb(ink)) for ink in inks], dtype=np.uint8)
    data = base64.standard_b64encode(zlib.compress(table[picture].tobytes(), 1)).decode("ascii")
    chunks = [data[at : at + _CHUNK] for at in range(0, len(data), _CHUNK)]
    keys = f"a=T,f=24,o=z,s={width},v={height},i={KITTY_IMAGE},p=1,c={columns},r={rows},C=1,q=2,"
    sent = []
    for number, chunk in enumerate(chunks, start=1):
        sent.append(f"\x1b_G{keys}m={int(number < len(chunks))};{chunk}\x1b\\")
        keys = "q=2,"
    return "".join(sent)


KITTY_AWAY = f"\x1b_Ga=d,d=I,i={KITTY_IMAGE},q=2\x1b\\"
"""Takes the picture away."""


def _repeated(run: re.Match[str]) -> str:
    return f"!{len(run[0])}{run[1]}"


def _rgb(ink: str) -> bytes:
    return bytes.fromhex(ink[1:])
