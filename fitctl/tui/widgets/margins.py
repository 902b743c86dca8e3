"""The Loop screen's design: its margins, and what it should leave, beside what is left."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from fitctl.messages.telemetry import LoopState
from fitctl.tui.look import DIM, INK, ORANGE, RED, Line, mark, number, shorten, text
from fitctl.tui.state import ConsoleState, error_rms
from fitctl.tui.widgets.panel import Panel

LEAST_PHASE_DEG = 30.0
LEAST_GAIN_DB = 6.0
MOST_SENSITIVITY = 2.0


class DesignInUse(NamedTuple):
    """A loop, and the name or the file of the design that it works with."""

    loop: str
    design: str


def design_in_use(loop: LoopState) -> DesignInUse:
    """The design that a loop works with."""
    return DesignInUse(loop.name, loop.controller_file or loop.controller)


class Margins(Panel):
    """The figures that `fitctl design` prints of the design in use; :meth:`show_result` passes them in.

    The limits beside the margins are the usual ones of textbooks (30 deg, 6 dB, 2).

    Parameters
    ----------
    why_unknown : callable
        Says why the margins of a loop's design cannot be known here; nothing if they can.
    """

    every: ClassVar[int] = 5

    def __init__(
        self, state: ConsoleState, title: str, why_unknown: Callable[[LoopState], str]
    ) -> None:
        super().__init__(state, title)
        self._why_unknown = why_unknown
        self._evaluated = DesignInUse("", "")
        self._figures: dict[str, Any] | None = None
        self._problem = ""

    def show_result(self, design: DesignInUse, output: str, status: int) -> None:
        """Show what the command printed of a design."""
        self._evaluated = design
        self._figures, self._problem = None, ""
        if status == 0:
            self._figures = json.loads(output.strip().splitlines()[-1])
        else:
            self._problem = output.strip().splitlines()[-1] if output.strip() else "no answer"

    def draw(self, columns: int, rows: int) -> list[Line]:
        """A row a figure."""
        loop, newest = self.state.loop, self.state.newest
        if loop is None or newest is None:
            return []
        file = Path(loop.state.controller_file).name
        head = [text("design ", DIM), text(loop.state.controller, INK, bold=True)]
        lines: list[Line] = [[*head, text(f" of {file}", DIM)] if file else head]
        unknown = self._why_unknown(loop.state)
        if unknown:
            return [
                *lines,
                *([text(line, DIM)] for line in textwrap.wrap(unknown, max(10, columns))),
            ]
        if self._evaluated != design_in_use(loop.state):
            return [*lines, [text("its margins are being worked out", DIM)]]
        figures = self._figures
        if figures is None:
            return [*lines, [text(shorten(f"✗ {self._problem}", columns), RED)]]
        if not figures["stable"]:
            return [*lines, [text("✗ unstable by the rig file's values", RED, bold=True)]]
        since_s = newest.time_s - self.state.window.rms_s
        rms = error_rms(loop.errors(self.state.window.rms_s), max(since_s, loop.state.since_s))
        measured_px = max(rms.az_px, rms.el_px) if not math.isnan(rms.az_px) else math.nan
        attenuation = "  ".join(
            f"{figures[f'attenuation_{hz:g}hz']:.1f}× at {hz:g} Hz"
            for hz in (0.1, 0.5, 1.0, 2.0)
            if figures.get(f"attenuation_{hz:g}hz") is not None
        )
        return [
            *lines,
            _figure("crossover", figures["crossover_hz"], "Hz"),
            _within("phase margin", figures["phase_margin_deg"], "°", least=LEAST_PHASE_DEG),
            _within("gain margin", figures["gain_margin_db"], "dB", least=LEAST_GAIN_DB),
            _within("sensitivity", figures["peak_sensitivity"], "at most", most=MOST_SENSITIVITY),
            [text(f"{'attenuates':<14}", DIM), text(shorten(attenuation, columns - 14), INK)],
            _figure("should leave", figures["residual_px"], "px, by linear theory", ".4f"),
            _figure("measured", measured_px, "px, the worse axis", ".4f"),
        ][:rows]


def _figure(name: str, value: float, unit: str, form: str = ".2f") -> Line:
    return [
        text(f"{name:<14}", DIM),
        text(f"{number(value, form):>8}", INK, bold=True),
        text(f" {unit}", DIM),
    ]


def _within(
    name: str, value: float, unit: str, least: float = -math.inf, most: float = math.inf
) -> Line:
    limit = f"≥ {least:g}" if math.isfinite(least) else f"≤ {most:g}"
    sign = mark(good=True) if least <= value <= most else text("▲", ORANGE, bold=True)
    return [*_figure(name, value, unit), text(f"  {limit} ", DIM), sign]
