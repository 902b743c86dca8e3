"""The Loop screen's error: how much of it each cause is responsible for, and its spectrum."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.error_budget import (
    Budget,
    LoopTheory,
    Motion,
    Spectra,
    budget,
    motion,
    pieces_of,
    predicted,
    spectra,
)
from fitctl.tui.draw import braille
from fitctl.tui.history import KEPT_S
from fitctl.tui.inks import AZ, DIM, EL, FAINT, INK, ORANGE, PINK, SKY, VIOLET, WHITE, YELLOW
from fitctl.tui.look import Line, mark, spread, text, width
from fitctl.tui.state import ConsoleState, LoopView
from fitctl.tui.widgets.margins import DesignFigures
from fitctl.tui.widgets.panel import Panel

LEAST_TICKS = 64
SETTLE_S = 10.0  # of the hand-over, as in a report
AXIS_COLUMNS = 7
STEPS = (1.0, 2.0, 5.0)
DESIGN, DISTURBANCE = PINK, DIM
DASHED, DOTTED = (1, 1, 1, 1, 0, 0), (1, 0)
CAUSE_LOOKS = {
    "air": ("█", SKY),
    "delay and hold": ("▓", VIOLET),
    "camera noise": ("▒", YELLOW),
    "hysteresis and backlash": ("░", PINK),
    "missing light": ("▚", INK),
    "unexplained": ("·", DIM),
}
_STAGES = ("fsm", "mirror", "siderostat", "link", "sky")
_NOT_EVALUATED = "error budget: needs the design's figures, see the panel Design"
_FIELDS = (
    "mid_exposure_s",
    "star_flux_dn",
    *(
        f"{what}_{axis}_{unit}"
        for what, unit in (("error", "px"), *((stage, "rad") for stage in _STAGES))
        for axis in ("az", "el")
    ),
)
Floats = NDArray[np.float64]


class _Record(NamedTuple):
    """The last stretch of one mode: ticks by field, and the rows of those with a star in pieces."""

    ticks: dict[str, Floats]
    pieces: list[NDArray[np.intp]]


def record_of(loop: LoopView, span_s: float, settle_s: float = 0.0) -> _Record:
    """The newest ticks of the present mode, at most `span_s`, from `settle_s` after it began."""
    since_s = max(loop.past.newest_s - span_s, loop.state.since_s + settle_s)
    fields = ("time_s", *_FIELDS)
    ticks = dict(zip(fields, loop.past.since(since_s, *fields).T, strict=True))
    usable = np.isfinite(ticks["error_az_px"] + ticks["mid_exposure_s"])
    return _Record(ticks, pieces_of(ticks["mid_exposure_s"], usable))


class ErrorBudget(Panel):
    """How much of the measured error each cause is responsible for, and whether so much was to be expected.

    Parameters
    ----------
    evaluated : DesignFigures
    """

    every: ClassVar[int] = 10

    def __init__(self, state: ConsoleState, title: str, evaluated: DesignFigures) -> None:
        super().__init__(state, title)
        self._evaluated = evaluated

    def draw(self, columns: int, rows: int) -> list[Line]:
        """A verdict, a bar if there are three rows, and the parts in percent."""
        loop = self.state.loop
        if loop is None:
            return []
        theory = self._evaluated.theory_of(loop.state)
        if loop.state.mode != "VERNIER":
            return [[text("error budget: in VERNIER only", DIM)]]
        if theory is None:
            return [[text(_NOT_EVALUATED, DIM)]]
        found = loop_budget(loop, theory)
        if found is None:
            why = f"error budget: needs {LEAST_TICKS} ticks with a star, from {SETTLE_S:g} s of VERNIER on"
            return [[text(why, DIM)]]
        lines = [
            _verdict_line(found, theory, columns),
            _bar_line(found, columns),
            _parts_line(found, columns),
        ]
        return lines if rows >= len(lines) else [lines[0], lines[-1]]


def loop_budget(loop: LoopView, theory: LoopTheory) -> Budget | None:
    """The error budget of the last minute in the present mode; None of too few ticks."""
    ticks, pieces = record_of(loop, KEPT_S, SETTLE_S)
    moved = motion(theory, ticks)
    if not pieces or not np.isfinite(moved.disturbance_px[np.concatenate(pieces)]).all():
        return None
    return budget(theory, ticks, moved, pieces)


def _verdict_line(found: Budget, theory: LoopTheory, columns: int) -> Line:
    sign = mark(good=True) if found.as_expected else text("▲", ORANGE, bold=True)
    unknown = [
        name
        for name, known in (
            ("hysteresis", theory.hysteresis_known),
            ("backlash", not math.isnan(theory.backlash_rad)),
        )
        if not known
    ]
    left = [sign, text(f" {found.verdict}", INK if found.as_expected else ORANGE, bold=True)]
    note = f"over {found.evaluated_s:.0f} s"
    if unknown:
        note = f"{' and '.join(unknown)} not identified: counted as air; {note}"
    return spread(left, [text(note, DIM)], columns)


def _bar_line(found: Budget, columns: int) -> Line:
    positive = {cause: max(0.0, part) for cause, part in found.fractions.items()}
    ends = np.rint(np.cumsum(list(positive.values())) / sum(positive.values()) * columns)
    lengths = np.diff(ends, prepend=0).astype(int).tolist()
    return [
        text(CAUSE_LOOKS[cause][0] * length, CAUSE_LOOKS[cause][1])
        for cause, length in zip(positive, lengths, strict=True)
        if length
    ]


def _parts_line(found: Budget, columns: int) -> Line:
    percent = found.percent
    there = {cause: part for cause, part in percent.items() if part}
    forms = ((percent, " %", "  "), (there, " %", "  "), (there, "", " "))
    lines = []
    for parts, unit, gap in forms:
        line: Line = []
        for cause, part in parts.items():
            symbol, colour = CAUSE_LOOKS[cause]
            line += [
                text(f"{gap if line else ''}{symbol} ", colour),
                text(f"{cause} ", DIM),
                text(f"{part}{unit}".replace("-", "−"), INK, bold=True),
            ]
        lines.append([*line, *([] if unit else [text(" %", DIM)])])
    return next((line for line in lines if width(line) <= columns), lines[-1])


class Spectrum(Panel):
    """Amplitude spectral density of both axes over the window, the disturbance, and the design's prediction.

    Parameters
    ----------
    evaluated : DesignFigures
    """

    every: ClassVar[int] = 10

    def __init__(self, state: ConsoleState, title: str, evaluated: DesignFigures) -> None:
        super().__init__(state, title)
        self._evaluated = evaluated

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The plot with its axes; a heading names the lines."""
        loop = self.state.loop
        if loop is None:
            return []
        theory = self._evaluated.theory_of(loop.state)
        found = loop_spectra(loop, max(self.state.window), theory)
        if found is None:
            return [[text(f"fewer than {LEAST_TICKS} ticks with a star in this mode", DIM)]]
        return _plot(found, theory, columns, rows)


def loop_spectra(loop: LoopView, span_s: float, theory: LoopTheory | None) -> Spectra | None:
    """Spectra of the newest ticks of the present mode; None of too few.

    Without a theory there is no disturbance: all of it is nan.
    """
    ticks, pieces = record_of(loop, span_s)
    if not pieces:
        return None
    error_px = np.column_stack([ticks["error_az_px"], ticks["error_el_px"]])
    unknown = np.full_like(error_px, math.nan)
    moved = Motion(error_px, unknown, unknown) if theory is None else motion(theory, ticks)
    exposed_s = ticks["mid_exposure_s"]
    period_s = float(np.median(np.diff(exposed_s[np.concatenate(pieces)])))
    return spectra(moved, exposed_s, pieces, period_s)


class _Curve(NamedTuple):
    """A line of the plot; which dots of it are drawn is repeated along the columns."""

    name: str
    x: Floats
    density: Floats
    colour: str
    pattern: tuple[int, ...] = (1,)


def _plot(found: Spectra, theory: LoopTheory | None, columns: int, rows: int) -> list[Line]:
    across, down = columns - AXIS_COLUMNS, max(1, rows - 2)
    if across < 4:
        return []
    low_hz, high_hz = float(found.frequency_hz[0]), float(found.frequency_hz[-1])
    curves = _curves(found, theory, across)
    limits = _limits(np.concatenate([curve.density for curve in curves]))
    layers = [(_grid(limits, low_hz, high_hz, down, across), FAINT)]
    canvases = []
    for curve in curves:
        dots = braille.empty(down, across)
        height = np.log(curve.density / limits[0]) / math.log(limits[1] / limits[0])
        braille.polyline(dots, curve.x, np.clip(height, 0.0, 1.0))
        dots &= np.resize(np.array(curve.pattern, dtype=bool), dots.shape[1])
        canvases.append(dots)
        layers.append((dots, curve.colour))
    layers.append((braille.meeting(*canvases[-2:]), WHITE))
    names: Line = []
    for name, colour in [*((curve.name, curve.colour) for curve in curves[::-1]), ("both", WHITE)]:
        names.append(text(f"{name} ", colour, bold=True))
    heading = spread(names, [text("px/√Hz", DIM)], columns)
    plot = [
        [text(label.rjust(AXIS_COLUMNS - 1), DIM), text("▕", FAINT), *line]
        for label, line in zip(_labels(limits, down), braille.layered(layers), strict=True)
    ]
    return [heading, *plot, _frequencies(low_hz, high_hz, across)]


def _curves(found: Spectra, theory: LoopTheory | None, across: int) -> list[_Curve]:
    """What is drawn, from the lowest to the uppermost: one point a column, the mean of the densities in it."""
    frequency_hz = found.frequency_hz
    x = np.log(frequency_hz / frequency_hz[0]) / math.log(frequency_hz[-1] / frequency_hz[0])
    column = np.minimum((x * across).astype(int), across - 1)
    count = np.bincount(column, minlength=across)

    def curve(name: str, power: Floats, *look: Any) -> _Curve:
        mean, at = np.bincount(column, power), np.bincount(column, x)
        filled = count > 0
        return _Curve(
            name, at[filled] / count[filled], np.sqrt(mean[filled] / count[filled]), *look
        )

    curves = []
    disturbance = found.disturbance.mean(axis=1)
    if theory is not None and np.isfinite(disturbance).all():
        curves.append(curve("disturbance", disturbance, DISTURBANCE, DOTTED))
    if theory is not None:
        curves.append(curve("design", predicted(theory, frequency_hz), DESIGN, DASHED))
    curves += [
        curve(name, found.error[:, number], colour)
        for number, name, colour in ((1, "el", EL), (0, "az", AZ))
    ]
    return curves


def _limits(densities: Floats) -> tuple[float, float]:
    """The range of the densities, widened to 1, 2 or 5 times a power of ten."""
    there = densities[densities > 0]
    if not len(there):
        return 1e-3, 1.0
    steps = _steps(float(there.min()) / 10, 10 * float(there.max()))
    low = max(step for step in steps if step <= there.min() * (1 + 1e-9))
    high = min(step for step in steps if step >= there.max() * (1 - 1e-9))
    return low, high if high > low else 10 * low


def _steps(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between two values."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (step * 10.0**decade for decade in decades for step in STEPS)
    return [step for step in steps if low * (1 - 1e-9) <= step <= high * (1 + 1e-9)]


def _grid(
    limits: tuple[float, float], low_hz: float, high_hz: float, rows: int, columns: int
) -> braille.Dots:
    dots = braille.empty(rows, columns)
    for value in _steps(*limits):
        dots[_place(value, limits, dots.shape[0]), ::6] = True
    for hz in _steps(low_hz, high_hz):
        dots[::4, dots.shape[1] - 1 - _place(hz, (low_hz, high_hz), dots.shape[1])] = True
    return dots


def _place(value: float, limits: tuple[float, float], rows: int) -> int:
    """The row of a value on a logarithmic scale, from the upper end."""
    low, high = limits
    return round((1 - math.log(value / low) / math.log(high / low)) * (rows - 1))


def _labels(limits: tuple[float, float], rows: int) -> list[str]:
    """Both ends, powers of ten, and what else has room."""
    labels = [""] * rows
    steps = _steps(*limits)
    for value in [limits[0], limits[1], *sorted(steps, key=lambda step: math.log10(step) % 1)]:
        row = _place(value, limits, rows)
        around = labels[max(0, row - 1) : row + 2]
        if not any(around):
            labels[row] = f"{value:g}".replace("e-0", "e-")
    return labels


def _frequencies(low_hz: float, high_hz: float, columns: int) -> Line:
    row = [" "] * (columns + AXIS_COLUMNS)
    free = 0
    for hz in _steps(low_hz, high_hz):
        label = f"{hz:g}"
        at = AXIS_COLUMNS + columns - 1 - _place(hz, (low_hz, high_hz), columns)
        at = min(at, len(row) - len(label))
        if at >= free:
            row[at : at + len(label)] = label
            free = at + len(label) + 1
    unit = "Hz"
    row[: len(unit)] = unit
    return [text("".join(row), DIM)]
