"""The Loop screen's spectrum of the pointing error, live."""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.tui.draw import braille
from fitctl.tui.look import DIM, FAINT, ORANGE, SKY, Line, spread, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

if TYPE_CHECKING:
    from types import ModuleType

LEAST_TICKS = 64
SEGMENTS = 4
AXIS_COLUMNS = 7
DECADES = 4
Floats = NDArray[np.float64]


class Spectra(NamedTuple):
    """Amplitude spectral densities; shapes (n,) and (n, 2)."""

    frequency_hz: Floats
    density_px_per_sqrt_hz: Floats


class Spectrum(Panel):
    """Amplitude spectral density of both axes over the window, both scales logarithmic."""

    every: ClassVar[int] = 10

    def __init__(self, state: ConsoleState, title: str = "") -> None:
        super().__init__(state, title)
        self._signal: ModuleType | None = None

    def on_mount(self) -> None:
        """Importing it takes half a second, for which the console must not stand still."""
        threading.Thread(target=self._import, name="console-import", daemon=True).start()

    def _import(self) -> None:
        import scipy.signal

        self._signal = scipy.signal

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The plot with its axes; a heading says what it is of."""
        loop, newest = self.state.loop, self.state.newest
        if loop is None or newest is None:
            return []
        if self._signal is None:
            return [[text("preparing", DIM)]]
        since_s = max(newest.time_s - max(self.state.window), loop.state.since_s)
        errors = loop.past.since(since_s, "time_s", "error_az_px", "error_el_px")
        spectra = spectra_of(self._signal, errors)
        if spectra is None:
            return [
                [text(f"fewer than {LEAST_TICKS} ticks in a row with a star in this mode", DIM)]
            ]
        return _plot(spectra, len(errors), columns, rows)


def spectra_of(signal: ModuleType, errors: Floats) -> Spectra | None:
    """By Welch's method, of the ticks since the star was last missed; None of too few.

    Parameters
    ----------
    signal : module
        ``scipy.signal``, which is slow to import.
    errors : array, shape (n, 3)
        Time in s, az and el in px.
    """
    missing = np.flatnonzero(~np.isfinite(errors[:, 1:]).all(axis=1))
    errors = errors[missing[-1] + 1 :] if len(missing) else errors
    if len(errors) < LEAST_TICKS:
        return None
    rate_hz = 1.0 / float(np.median(np.diff(errors[:, 0])))
    segment = max(LEAST_TICKS, 2 * len(errors) // (SEGMENTS + 1))
    frequency_hz, density = signal.welch(
        errors[:, 1:], rate_hz, nperseg=min(segment, len(errors)), axis=0
    )
    return Spectra(frequency_hz[1:], np.sqrt(density[1:]))


def _plot(spectra: Spectra, ticks: int, columns: int, rows: int) -> list[Line]:
    frequency_hz, density = spectra
    across, down = columns - AXIS_COLUMNS, max(1, rows - 2)
    if across < 4:
        return []
    top = math.ceil(math.log10(float(density.max(initial=1e-9))))
    low_hz, high_hz = float(frequency_hz[0]), float(frequency_hz[-1])
    x = np.log10(frequency_hz / low_hz) / math.log10(high_hz / low_hz)
    layers = [(_grid(top, low_hz, high_hz, down, across), FAINT)]
    for axis, colour in enumerate((SKY, ORANGE)):
        dots = braille.empty(down, across)
        with np.errstate(divide="ignore"):
            y = 1 + (np.log10(density[:, axis]) - top) / DECADES
        braille.polyline(dots, x, np.clip(y, 0.0, 1.0))
        layers.append((dots, colour))
    step_hz = frequency_hz[1] - frequency_hz[0]
    rms_px = np.sqrt(np.sum(density**2, axis=0) * step_hz)
    heading = spread(
        [text("az ", SKY, bold=True), text("el", ORANGE, bold=True), text("  px/√Hz", DIM)],
        [text(f"{ticks} ticks; RMS in it {rms_px[0]:.3f} {rms_px[1]:.3f} px", DIM)],
        columns,
    )
    labels = _labels(top, down)
    plot = [
        [text(label.rjust(AXIS_COLUMNS - 1), DIM), text("▕", FAINT), *line]
        for label, line in zip(labels, braille.layered(layers), strict=True)
    ]
    return [heading, *plot, _frequencies(low_hz, high_hz, across)]


def _grid(top: int, low_hz: float, high_hz: float, rows: int, columns: int) -> braille.Dots:
    dots = braille.empty(rows, columns)
    for decade in range(DECADES + 1):
        dots[round(decade / DECADES * (dots.shape[0] - 1)), ::6] = True
    for hz in _ticks_hz(low_hz, high_hz):
        column = round(math.log(hz / low_hz) / math.log(high_hz / low_hz) * (dots.shape[1] - 1))
        dots[::4, column] = True
    return dots


def _ticks_hz(low_hz: float, high_hz: float) -> list[float]:
    decades = range(math.floor(math.log10(low_hz)), math.ceil(math.log10(high_hz)) + 1)
    return [s * 10.0**d for d in decades for s in (1, 2, 5) if low_hz <= s * 10.0**d <= high_hz]


def _labels(top: int, rows: int) -> list[str]:
    labels = [""] * rows
    for decade in range(DECADES + 1):
        labels[min(rows - 1, round(decade / DECADES * (rows - 1)))] = f"{10.0 ** (top - decade):g}"
    return labels


def _frequencies(low_hz: float, high_hz: float, columns: int) -> Line:
    row = [" "] * (columns + AXIS_COLUMNS)
    free = 0
    for hz in _ticks_hz(low_hz, high_hz):
        label = f"{hz:g}"
        at = AXIS_COLUMNS + round(
            math.log(hz / low_hz) / math.log(high_hz / low_hz) * (columns - 1)
        )
        at = min(at, len(row) - len(label))
        if at >= free:
            row[at : at + len(label)] = label
            free = at + len(label) + 1
    unit = "Hz"
    row[: len(unit)] = unit
    return [text("".join(row), DIM)]
