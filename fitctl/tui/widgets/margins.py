"""The Loop screen's design: its margins, and what it should leave, beside what is left."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from fitctl.error_budget import LoopTheory, theory_from_plain
from fitctl.messages.telemetry import LoopState
from fitctl.tui.inks import DIM, INK, ORANGE, RED
from fitctl.tui.look import Line, mark, number, shorten, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

LEAST_PHASE_DEG = 30.0
LEAST_GAIN_DB = 6.0
MOST_SENSITIVITY = 2.0
_NAME_COLUMNS = 14


class DesignInUse(NamedTuple):
    """What a loop works with: a design's name, its file or its parameters, and the noise that it is made for.

    The noise is None where it is the rig file's, or among the parameters. The digest is that of a file's design
    as the loop loaded it.
    """

    loop: str
    design: str
    noise_px: float | None = None
    digest: str = ""


def design_in_use(loop: LoopState) -> DesignInUse:
    """The design that a loop works with."""
    return DesignInUse(loop.name, loop.design, loop.noise_px, loop.controller_digest)


class DesignFigures:
    """What `fitctl design` printed of the design in use, for all panels of the Loop screen.

    Attributes
    ----------
    of : DesignInUse
        The design; without a name before anything was printed.
    figures : dict or None
    theory : LoopTheory or None
        For the error budget.
    problem : str
        Why there are no figures.
    """

    def __init__(self) -> None:
        self.of = DesignInUse("", "")
        self.figures: dict[str, Any] | None = None
        self.theory: LoopTheory | None = None
        self.problem = ""

    def accept(self, design: DesignInUse, output: str, status: int) -> None:
        """Keep what the command printed of a design."""
        self.of, self.figures, self.theory, self.problem = design, None, None, ""
        if status != 0:
            self.problem = output.strip().splitlines()[-1] if output.strip() else "no answer"
            return
        try:
            figures = json.loads(output.strip().rpartition("\n")[2])
        except ValueError as error:
            self.problem = f"fitctl design printed no JSON: {error}"
            return
        if "stable" not in figures:
            # A supervisor elsewhere may name anything that the command knows, such as "bound".
            self.problem = f"{design.design} is not a design"
            return
        if design.digest not in {"", figures.get("digest")}:
            self.problem = f"{Path(design.design).name} has changed since the loop loaded it"
            return
        self.figures, theory = figures, figures.pop("theory", None)
        self.theory = None if theory is None else theory_from_plain(theory)

    def theory_of(self, loop: LoopState) -> LoopTheory | None:
        """The theory of a loop as it works now; None in other modes than VERNIER and where it is not known."""
        at_work = loop.mode == "VERNIER" and self.of == design_in_use(loop)
        return self.theory if at_work else None


class Margins(Panel):
    """The figures of the design in use.

    The limits beside the margins are the usual ones of textbooks (30 deg, 6 dB, 2).

    Parameters
    ----------
    evaluated : DesignFigures
    why_unknown : callable
        Returns why the margins of a loop's design cannot be known here; nothing if they can.
    """

    every: ClassVar[int] = 5

    def __init__(
        self,
        state: ConsoleState,
        title: str,
        evaluated: DesignFigures,
        why_unknown: Callable[[LoopState], str],
    ) -> None:
        super().__init__(state, title)
        self._evaluated = evaluated
        self._why_unknown = why_unknown

    def draw(self, columns: int, rows: int) -> list[Line]:
        """A row a figure."""
        loop = self.state.loop
        if loop is None:
            return []
        file = Path(loop.state.controller_file).name
        head = [text("design ", DIM), text(loop.state.controller, INK, bold=True)]
        lines: list[Line] = [[*head, text(f" of {file}", DIM)] if file else head]
        lines += learning_lines(loop.state, columns)
        unknown = self._why_unknown(loop.state)
        if unknown:
            return [
                *lines,
                *([text(line, DIM)] for line in textwrap.wrap(unknown, max(10, columns))),
            ]
        if self._evaluated.of != design_in_use(loop.state):
            return [*lines, [text("computing its margins", DIM)]]
        figures = self._evaluated.figures
        if figures is None:
            return [*lines, [text(shorten(f"✗ {self._evaluated.problem}", columns), RED)]]
        if not figures["stable"]:
            return [*lines, [text("✗ unstable with the rig file's values", RED, bold=True)]]
        attenuation = ""
        for hz in (0.1, 0.5, 1.0, 2.0):
            value = figures.get(f"attenuation_{hz:g}hz")
            longer = attenuation if value is None else f"{attenuation}  {value:.1f}× at {hz:g} Hz"
            if len(longer) - 2 <= columns - _NAME_COLUMNS:
                attenuation = longer
        return [
            *lines,
            _figure("crossover", figures["crossover_hz"], "Hz"),
            _within("phase margin", figures["phase_margin_deg"], "°", least=LEAST_PHASE_DEG),
            _within("gain margin", figures["gain_margin_db"], "dB", least=LEAST_GAIN_DB),
            _within("sensitivity", figures["peak_sensitivity"], "at most", most=MOST_SENSITIVITY),
            [text("attenuates".ljust(_NAME_COLUMNS), DIM), text(attenuation.strip(), INK)],
            _figure("should leave", figures["residual_px"], "px, true star", ".4f"),
        ][:rows]


def learning_lines(loop: LoopState, columns: int) -> list[Line]:
    """What was learnt of the night, and what became of it; no line of a loop that does not learn."""
    learning = loop.learning
    if learning is None or learning.setting == "off":
        return []
    report = learning.report
    gain, colour = "", INK
    if learning.state == "collecting":
        gain, colour = "collecting frames in VERNIER", DIM
    elif learning.state == "kept" and report is not None and not report.fits:
        gain, colour = "the model does not explain the frames: kept", ORANGE
    elif learning.state == "failed":
        gain, colour = "nothing could be learnt; the design is kept", ORANGE
    elif learning.state == "kept":
        gain = "no other design would leave clearly less"
    elif learning.state == "advice" and report is not None:
        gain = f"advice: {report.learnt_px:.4f} px instead of {report.present_px:.4f}"
        colour = ORANGE
    elif learning.state == "in force":
        gain = f"on frames {learning.measured_px:.4f} px, expected {learning.expected_px:.4f}"
    elif learning.state == "fell back":
        gain, colour = "returned to the previous design", ORANGE
    lines = _wrapped("learning", gain, colour, columns)
    if not math.isnan(learning.before_px):
        before = f"{learning.before_px:.4f} px on the same frames, computed"
        lines += _wrapped("before", before, INK, columns)
    if learning.state == "advice":
        command = f"fitctl send controller learnt --loop {loop.name}"
        lines += _wrapped("to apply", command, INK, columns)
    return lines + _wrapped("night", learning.text, DIM, columns)


def _wrapped(name: str, said: str, colour: str, columns: int) -> list[Line]:
    """A text over as many rows as it needs, up to four; no row without one."""
    room = max(10, columns - _NAME_COLUMNS)
    pieces = textwrap.wrap(said, room, max_lines=4, placeholder="…", break_on_hyphens=False)
    return [
        [text((name if number_ == 0 else "").ljust(_NAME_COLUMNS), DIM), text(piece, colour)]
        for number_, piece in enumerate(pieces)
    ]


def _figure(name: str, value: float, unit: str, form: str = ".2f") -> Line:
    return [
        text(name.ljust(_NAME_COLUMNS), DIM),
        text(f"{number(value, form):>8}", INK, bold=True),
        text(f" {unit}", DIM),
    ]


def _within(
    name: str, value: float, unit: str, least: float = -math.inf, most: float = math.inf
) -> Line:
    limit = f"≥ {least:g}" if math.isfinite(least) else f"≤ {most:g}"
    # By the digits that are shown: a learnt design is made to end at its limits.
    sign = mark(good=True) if least <= round(value, 2) <= most else text("▲", ORANGE, bold=True)
    return [*_figure(name, value, unit), text(f"  {limit} ", DIM), sign]
