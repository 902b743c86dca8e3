"""The error of each loop over the last seconds, all on one time axis; while searching, the search."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment

from fitctl.tui.draw import braille
from fitctl.tui.inks import AZ, DIM, EL, FAINT, GREEN, INK, WHITE
from fitctl.tui.look import (
    Line,
    clickable,
    mark,
    number,
    spread,
    text,
    wall,
    width,
)
from fitctl.tui.loops.band import age, holds, mode_look, present_rms
from fitctl.tui.state import ConsoleState, LoopView, Rms
from fitctl.tui.widgets.panel import Panel
from fitctl.tui.widgets.searchmap import search_lines

AXIS_COLUMNS = 6
STEPS = (1.0, 2.0, 5.0)
TIME_AXIS_FROM_ROWS = 9
SEVERAL_FROM_ROWS = 16
TITLES = {
    (True, "stellar"): "Search on the sky",
    (True, "metrology"): "Search for the beam",
    (False, "stellar"): "Pointing error",
    (False, "metrology"): "Beam error",
}


class Unit(NamedTuple):
    """In which unit a loop's errors are shown, and how many there are in a pixel of the camera."""

    name: str
    per_px: float


class Traces(Panel):
    """Azimuth above elevation: value now, RMS against the requirement, and the trace.

    With several loops and room for them, all loops are below each other on one time axis, the chosen one
    larger.
    """

    def draw(self, columns: int, rows: int) -> list[Line]:
        """All loops, or the chosen one; without room for a time axis the headings have its span."""
        loop = self.state.loop
        if loop is None or self.state.newest is None:
            return []
        searching = loop.state.mode == "ACQUISITION"
        self.border_title = TITLES[searching, loop.state.kind]
        loops = list(self.state.loops.values())
        if len(loops) > 1 and rows >= SEVERAL_FROM_ROWS:
            self.border_title = "Errors of all loops"
            return self._multiples(loops, columns, rows)
        return self._chosen(loop, columns, rows, rows >= TIME_AXIS_FROM_ROWS)

    def _chosen(self, loop: LoopView, columns: int, rows: int, time_axis: bool) -> list[Line]:
        """The chosen loop alone: its search, or its errors."""
        if loop.state.mode == "ACQUISITION":
            return self._search(loop, columns, rows)
        lines = loop_traces(self.state, loop, columns, rows - time_axis, spanned=not time_axis)
        return [*lines, self._time_axis(columns)] if time_axis else lines

    def _search(self, loop: LoopView, columns: int, rows: int) -> list[Line]:
        frame = self.state.newest.frame if self.state.newest else None
        return search_lines(loop, frame.width_px if frame else 0, columns, rows)

    def _multiples(self, loops: list[LoopView], columns: int, rows: int) -> list[Line]:
        """Each loop under a heading of its own, in the supervisor's order."""
        others = len(loops) - 1
        each = 1 + 2 * max(1, (rows // (len(loops) + 1) - 1) // 2)
        lines: list[Line] = []
        for loop in loops:
            is_chosen = loop.state.name == self.state.shown
            high = rows - 1 - others * each if is_chosen else each
            lines.append(self._heading(loop, columns, is_chosen))
            if is_chosen and loop.state.mode == "ACQUISITION":
                lines += _filled(self._search(loop, columns, high - 1), high - 1)
            else:
                lines += _filled(axis_traces(self.state, loop, columns, high - 1), high - 1)
        return [*lines, self._time_axis(columns)]

    def _heading(self, loop: LoopView, columns: int, is_chosen: bool) -> Line:
        """Name, mode, and for each axis value and RMS."""
        look, unit = mode_look(loop), unit_of(loop)
        head: Line = [
            text("▸" if is_chosen else " ", INK, bold=True),
            text(f"{loop.state.name} ", WHITE if is_chosen else INK, bold=True),
            text(f"{look.symbol} {loop.state.mode}", look.colour, bold=True),
        ]
        if loop.state.mode == "ACQUISITION":  # what a search passes over is no error of a star
            return clickable(head, f"app.show_loop({loop.state.name!r})")
        rms = present_rms(self.state, loop)
        requirement = unit.per_px * loop.state.requirement_px
        figures: Line = []
        for name, colour, rms_px in (("az", AZ, rms.az_px), ("el", EL, rms.el_px)):
            figures += [text(f"  {name} ", colour, bold=True)]
            figures += [text(f"{number(unit.per_px * rms_px, '.3f')}", INK, bold=True)]
        figures += [text(f" {unit.name} RMS of {requirement:.3g}", DIM)]
        if holds(loop) and not math.isnan(rms.az_px):
            good = max(rms.az_px, rms.el_px) <= loop.state.requirement_px
            figures += [text(" "), mark(good=good)]
        return clickable(spread(head, figures, columns), f"app.show_loop({loop.state.name!r})")

    def _time_axis(self, columns: int) -> Line:
        """From the left end to now; of old data to how old they are, and of the past to its time."""
        state, span_s = self.state, self.state.window.trace_s
        room = columns - AXIS_COLUMNS
        right = f"{age(state.silent_s)} ago" if state.stale else "now"
        if not state.live and state.newest is not None:
            right = f"{wall(state.wall_s(state.newest.time_s))} UTC"
        left, middle = f"−{span_s:g} s", f"−{span_s / 2:g} s"
        row = left + middle.center(room - len(left) - len(right)) + right
        return [text(" " * AXIS_COLUMNS + row, DIM)]


def unit_of(loop: LoopView) -> Unit:
    """Pixels of the camera for a star, arcseconds for a metrology loop's beam."""
    if loop.state.kind == "metrology":
        return Unit("″", loop.state.sky_arcsec_per_px)
    return Unit("px", 1.0)


def loop_traces(
    state: ConsoleState, loop: LoopView, columns: int, rows: int, *, spanned: bool
) -> list[Line]:
    """Both axes of a loop with equal room, each under a line of its value and RMS.

    `spanned`: the lines have the span of the traces.
    """
    rms, unit = present_rms(state, loop), unit_of(loop)
    errors = loop.errors(state.window.trace_s)
    span = f" · {state.window.trace_s:g} s"
    traces = axis_traces(state, loop, columns, rows - 2)
    lines: list[Line] = []
    for index, (name, colour, rms_px) in enumerate(
        (("az", AZ, rms.az_px), ("el", EL, rms.el_px)), start=1
    ):
        now = unit.per_px * float(errors[-1, index]) if len(errors) else math.nan
        heading = [text(f"{name} ", colour, bold=True)]
        heading.append(text(f"{number(now, '+.3f')} {unit.name}", INK, bold=True))
        right = _rms_line(state, rms_px, rms, loop, columns - width(heading) - 1)
        if spanned and width(heading) + len(span) + width(right) < columns:
            heading.append(text(span, DIM))
        half = len(traces) // 2
        lines.append(spread(heading, right, columns))
        lines += traces[:half] if index == 1 else traces[half:]
    return lines


def axis_traces(state: ConsoleState, loop: LoopView, columns: int, rows: int) -> list[Line]:
    """The traces of az and el, as many rows each, on one scale; a line marks where the mode began.

    The scale is that of the present mode's errors; larger ones from before lie on the edge.
    """
    now_s = state.newest.time_s if state.newest else math.nan
    span_s, unit, since_s = state.window.trace_s, unit_of(loop), loop.state.since_s
    errors = loop.errors(span_s)
    requirement = unit.per_px * loop.state.requirement_px
    in_mode = unit.per_px * errors[errors[:, 0] >= max(since_s, now_s - span_s), 1:]
    limit = axis_limit(in_mode, requirement)
    return [
        line
        for index, colour in ((1, AZ), (2, EL))
        for line in trace_lines(
            errors[:, 0],
            unit.per_px * errors[:, index],
            now_s=now_s,
            span_s=span_s,
            limit=limit,
            requirement=requirement,
            colour=colour,
            columns=columns,
            rows=max(1, rows // 2),
            changed=(since_s, mode_look(loop).colour),
        )
    ]


def _filled(lines: list[Line], rows: int) -> list[Line]:
    return [*lines[:rows], *([] for _ in range(rows - len(lines)))]


def axis_limit(errors: NDArray[np.float64], requirement: float) -> float:
    """Half height of the traces: the least 1, 2 or 5 times a power of ten that holds all errors.

    Never less than twice the requirement, so that its band always shows.
    """
    finite = errors[np.isfinite(errors)]
    need = max(2 * requirement, 1.05 * float(np.abs(finite).max(initial=0.0)))
    decade = 10.0 ** math.floor(math.log10(need))
    return next(s * decade for s in (*STEPS, 10.0) if s * decade >= need * (1 - 1e-9))


def trace_lines(
    times_s: NDArray[np.float64],
    errors: NDArray[np.float64],
    *,
    now_s: float,
    span_s: float,
    limit: float,
    requirement: float,
    colour: str,
    columns: int,
    rows: int,
    changed: tuple[float, str] = (math.nan, INK),
) -> list[Line]:
    """One trace with its scale at the left and dotted lines at zero and at ± the requirement.

    `changed` is when the present mode began, and the colour of the line across that marks it.
    """
    across = columns - AXIS_COLUMNS - 1
    if across < 1:
        return [[] for _ in range(rows)]
    trace, guides, change = (braille.empty(rows, across) for _ in range(3))
    braille.envelope(trace, times_s, errors, now_s=now_s, span_s=span_s, limit=limit)
    braille.guide(guides, 0.0, limit, 6)
    for sign in (-1, 1):
        braille.guide(guides, sign * requirement, limit, 2)
    since_s, ink = changed
    if now_s - span_s < since_s <= now_s:
        change[:, int((since_s - now_s + span_s) / span_s * (change.shape[1] - 1))] = True
    labels = _axis_labels(rows, limit, requirement)
    layers = [(guides, GREEN), (change, ink), (trace, colour)]
    return [
        [label, text("▕", FAINT), *line]
        for label, line in zip(labels, braille.layered(layers), strict=True)
    ]


def _axis_labels(rows: int, limit: float, requirement: float) -> list[Segment]:
    """What has no row of its own goes: first the ends of the scale, then the requirement."""
    labels = [text(" " * (AXIS_COLUMNS - 1))] * rows
    ends = ((limit, "+", DIM), (-limit, "−", DIM))
    band = ((requirement, "+", GREEN), (-requirement, "−", GREEN))
    for value, sign, colour in ((0.0, "", DIM), *band, *ends):
        y = min(rows - 1, int((1 - value / limit) / 2 * rows))
        if labels[y].text.isspace():
            labels[y] = text(f"{sign}{abs(value):.3g}".rjust(AXIS_COLUMNS - 1), colour)
    return labels


def _rms_line(state: ConsoleState, rms_px: float, rms: Rms, loop: LoopView, room: int) -> Line:
    """The RMS of one axis: in the loop's unit, as a part of the requirement, and of a star on the sky."""
    unit = unit_of(loop)
    if math.isnan(rms_px):
        return [text(f"no {'beam' if loop.state.kind == 'metrology' else 'star'}, no RMS", DIM)]
    good = rms_px <= loop.state.requirement_px
    sign = mark(good=good) if holds(loop) else text(" ")
    part = rms_px / loop.state.requirement_px
    ratio = f"{100 * part:.0f} %" if part < 10 else f"{part:.0f}×"
    requirement = unit.per_px * loop.state.requirement_px
    named = f"{'of ' if part < 10 else ''}{requirement:.3g} {unit.name} "
    on_sky = f"{1000 * loop.state.sky_arcsec_per_px * rms_px:.0f} mas"
    if loop.state.kind == "metrology":
        on_sky = ""
    window_s = state.window.rms_s
    usual = rms.span_s >= 0.9 * window_s and window_s == 10.0
    value = f"{unit.per_px * rms_px:.3f}"
    head = [
        text("rms " if usual else f"rms {rms.span_s:.0f} s ", DIM),
        text(value, INK, bold=True),
        text(f" {ratio} ", INK),
    ]
    sky = text(f" {on_sky}", DIM)
    forms = (
        [
            text(f"RMS {rms.span_s:.0f} s  ", DIM),
            text(f"{value} {unit.name}", INK, bold=True),
            text(f" = {ratio} {named}", INK),
            sign,
            text(f"  {on_sky} on the sky" if on_sky else "", DIM),
        ],
        [*head, text(named, INK), sign, sky],
        [*head, sign, sky],
        [*head, sign],
    )
    return next((form for form in forms if width(form) <= room), forms[-1])
