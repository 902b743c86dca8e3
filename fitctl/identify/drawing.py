"""How drawings look: an empty one, and its colours."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind people tell apart; lines differ in style besides.
BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE, BLACK = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#56B4E9",
    "#CC79A7",
    "#000000",
)

# What a plot's colours become on a dark page: its paper and ink, then its series.
ON_DARK = {
    "#ffffff": "#1b1f24",
    BLACK: "#e8ebee",
    "#cccccc": "#66707c",
    "#808080": "#a3adb8",
    BLUE: "#5cb3ea",
    ORANGE: "#f0b73f",
    GREEN: "#3ecf9f",
    VERMILION: "#ff8a4c",
    "#1f77b4": "#5cb3ea",
    "#2ca02c": "#3ecf9f",
}


def new_figure(width_in: float = 7.0, height_in: float = 4.8) -> Figure:
    """An empty figure whose lettering can be read in print."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def for_dark_pages(svg: str) -> str:
    """Add the colours of a dark page to an SVG of matplotlib's; light pages and paper show it unchanged.

    An SVG that has them already stays as it is.
    """
    if "prefers-color-scheme" in svg:
        return svg
    rules = [
        f'[style*="{part}: {light.lower()}"] {{ {part}: {dark} !important }}'
        for light, dark in ON_DARK.items()
        for part in ("fill", "stroke")
    ]
    # Lettering has no style of its own: it inherits.
    style = "\n".join(
        ["@media (prefers-color-scheme: dark) {", f"svg {{ fill: {ON_DARK[BLACK]} }}", *rules, "}"]
    )
    return re.sub(r"</style>", f"\n{style}\n</style>", svg, count=1)
