"""How a report's plots look, on paper, on a light page and on a dark one."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.figures.plate import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.floating]

INK, GRID, FAINT = "#20262e", "#d5d9de", "#8a929c"
AZ, EL = BLUE, VERMILION
SERIES = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
# On the page these are the style sheet's, which has a light and a dark one of each.
VARIABLES = {
    INK: "ink",
    GRID: "grid",
    FAINT: "faint",
    BLUE: "blue",
    VERMILION: "vermilion",
    GREEN: "green",
    ORANGE: "orange",
    PURPLE: "purple",
    SKY: "sky",
}
BINS = 900  # of a trace: about as many as a page shows
_STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.1,
    "axes.formatter.useoffset": False,
    "svg.fonttype": "none",
    "path.simplify_threshold": 0.5,
}


class Plot(NamedTuple):
    """One plot of a report.

    Attributes
    ----------
    name : str
        Of its files, without suffix.
    title, caption : str
    figure : Figure
    """

    name: str
    title: str
    caption: str
    figure: Figure


class TimeAxis(NamedTuple):
    """In what time is drawn."""

    s_per_unit: float
    label: str


def time_axis(duration_s: float, start: str) -> TimeAxis:
    """The unit that suits, and a label that says from when; `start` is a UTC time."""
    for s_per_unit, unit, most in ((1.0, "s", 600.0), (60.0, "min", 3 * 3600.0)):
        if duration_s <= most:
            return TimeAxis(s_per_unit, f"{unit} after {start}")
    return TimeAxis(3600.0, f"h after {start}")


def style() -> dict[str, object]:
    """For ``matplotlib.rc_context`` around drawing and writing."""
    return dict(_STYLE)


def panels(
    rows: int, height_in: float, columns: int = 1, *, share_x: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of a page's width and its axes, row by row."""
    figure = new_figure(9.0, height_in)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share_x and columns == 1)
    return figure, list(axes.ravel())


def envelope(time_s: Floats, values: Floats, bins: int = BINS) -> tuple[Floats, Floats, Floats]:
    """A long series as what a page can show: lowest and highest of each of `bins` equal times.

    Returns
    -------
    time_s, low, high : arrays, shape (at most bins,)
        Middles of the times, NaN where there is nothing; a series that is short comes as it is.
    """
    if len(time_s) <= bins:
        return time_s, values, values
    edges_s = np.linspace(time_s[0], time_s[-1], bins + 1)
    begin = np.searchsorted(time_s, edges_s[:-1])
    filled = np.flatnonzero(begin < np.append(begin[1:], len(time_s)))
    low, high = np.full(bins, np.nan), np.full(bins, np.nan)
    low[filled] = np.fmin.reduceat(values, begin[filled])
    high[filled] = np.fmax.reduceat(values, begin[filled])
    return (edges_s[:-1] + edges_s[1:]) / 2, low, high


def trace(axes: Axes, time: TimeAxis, series: tuple[Floats, Floats], color: str, label: str) -> None:
    """A series against time, as a band where there is more of it than a page can show."""
    time_s, values = series
    if len(time_s) == 0:
        return
    at_s, low, high = envelope(time_s, values)
    if low is high:
        axes.plot(at_s / time.s_per_unit, low, color=color, label=label)
        return
    # Bands meet where the next begins, or every second pixel would be empty.
    axes.fill_between(
        at_s / time.s_per_unit, low, high, color=color, alpha=0.55, linewidth=0.4, label=label
    )


def inline_svg(figure: Figure, name: str, title: str) -> str:
    """A figure as SVG to stand within a page: its colours the page's, its names its own."""
    import matplotlib

    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", svg)
    for color, variable in VARIABLES.items():
        svg = re.sub(f"{color}\\b", f"var(--{variable})", svg, flags=re.IGNORECASE)
    # The style sheet sets the width; the view box keeps the shape.
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    label = title.replace("&", "&amp;").replace('"', "&quot;")
    return svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)


def save_plot(plot: Plot, folder: Path) -> None:
    """PNG and SVG of a plot, as they are printed: on white.

    Raises
    ------
    OSError
        If they cannot be written.
    """
    save(plot.figure, folder, plot.name)
