"""How a report's plots look, on paper, on a light page and on a dark one."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from fitctl.identify.drawing import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, new_figure
from fitctl.tui.inks import FAULT, MODE_COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.floating]

INK, GRID, FAINT = "#20262e", "#d5d9de", "#8a929c"
AZ, EL = BLUE, VERMILION
COLORS = {"az": AZ, "el": EL}
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
VARIABLES |= {
    color.light: f"mode-{name.lower()}"
    for name, color in MODE_COLOURS.items()
    if color.light not in VARIABLES
} | {FAULT.light: "mode-fault"}
_DPI = 120
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
BINS = 900  # of a trace: about as many as a page shows
_STYLE: Any = {
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
    "text.parse_math": False,  # a name or an event with dollar signs is text
    "path.simplify_threshold": 0.5,
}


class Plot(NamedTuple):
    """One plot of a report.

    Attributes
    ----------
    name : str
        Of its files, without suffix; see :attr:`stem`.
    title, caption : str
        Without a figure, the caption says why there is nothing to draw.
    figure : Figure or None
    """

    name: str
    title: str
    caption: str
    figure: Figure | None

    @property
    def stem(self) -> str:
        """The name as files and identifiers in a page have it, whatever was in it."""
        return re.sub(r"[^A-Za-z0-9_-]", "_", self.name)


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


@contextmanager
def styled() -> Iterator[None]:
    """Within, figures are made and written as reports have them."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def panels(
    rows: int, height_in: float, columns: int = 1, heights: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """A figure of a page's width and its axes, row by row; one column shares its x axis."""
    figure = new_figure(9.0, height_in)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=columns == 1, height_ratios=heights)
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


def trace(
    axes: Axes, time: TimeAxis, time_s: Floats, values: Floats, color: str, label: str
) -> None:
    """A series against time, as a band where there is more of it than a page can show."""
    if len(time_s) == 0:
        return
    at_s, low, high = envelope(time_s, values)
    if low is high:
        axes.plot(at_s / time.s_per_unit, low, color=color, label=label)
        return
    # Bands meet where the next begins, or every second pixel would be empty.
    axes.fill_between(
        at_s / time.s_per_unit, low, high, color=color, alpha=0.6, linewidth=0.9, label=label
    )


def limit(axes: Axes, value: float, label: str | None = None) -> None:
    """A dashed line that is not to be passed."""
    axes.axhline(value, color=INK, linestyle="--", linewidth=0.9, label=label)


def legend_above(axes: Axes, columns: int) -> None:
    """A legend beside the title, where it hides nothing; none for an empty plot."""
    if not axes.get_legend_handles_labels()[0]:
        return
    axes.legend(ncols=columns, loc="lower right", bbox_to_anchor=(1, 0.98), borderaxespad=0)


def span(axes: Sequence[Axes], time: TimeAxis, duration_s: float) -> None:
    """All of the run, no more: times of several plots then stand below each other."""
    for one in axes:
        one.set_xlim(0, max(duration_s, 1e-3) / time.s_per_unit)


def plain_number(value: float) -> str:
    """As people write it, with powers of ten where it is very small or large: 0.002, 10⁻⁵, 2·10⁻⁵."""
    digits, power, exponent = f"{value:g}".partition("e")
    if not power:
        return digits
    raised = f"10{str(int(exponent)).translate(_RAISED)}"
    return raised if digits == "1" else f"{digits}·{raised}"


def decimal(axis: Axis, *, dense: bool = False) -> None:
    """Plain numbers on a logarithmic axis; at 1, 2 and 5 where it is short. Without data an axis is none."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if axis.get_scale() != "log":
        return
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if dense else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _position: plain_number(value)))
    axis.set_minor_formatter(NullFormatter())


def draw(plot: Plot, folder: Path) -> str:
    """Write a plot as PNG and SVG, on white as they are printed; returns it as SVG to stand within a page.

    A plot without a figure is an empty text.

    Raises
    ------
    OSError
        If they cannot be written.
    """
    import matplotlib

    figure = plot.figure
    if figure is None:
        return ""
    with matplotlib.rc_context({"svg.hashsalt": plot.stem}), warnings.catch_warnings():
        # A name may be in any writing; in an SVG the reader's own fonts show it.
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from", UserWarning)
        figure.savefig(folder / f"{plot.stem}.png", dpi=_DPI, metadata={"Software": None})
        figure.set_layout_engine("none")  # it is laid out: once is slow enough
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    on_white = re.sub(r"(<svg[^>]*>)", r'\1<rect width="100%" height="100%" fill="#ffffff"/>', svg)
    (folder / f"{plot.stem}.svg").write_text(on_white, encoding="utf-8")
    return within_page(svg[svg.index("<svg") :], plot.stem, plot.title)


def within_page(svg: str, name: str, title: str) -> str:
    """An SVG whose colours are the page's, whose names are its own, and whose width the style sheet sets."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", svg)
    for color, variable in VARIABLES.items():
        svg = re.sub(f"{color}\\b", f"var(--{variable})", svg, flags=re.IGNORECASE)
    for size in ("width", "height"):
        svg = re.sub(rf'(<svg[^>]*?) {size}="[^"]*"', r"\1", svg, count=1)
    return svg.replace("<svg", f'<svg role="img" aria-label={quoteattr(title)}', 1)
