"""The pointing error of both axes over the last seconds; while searching, the search."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment

from fitctl.tui.draw import braille
from fitctl.tui.look import (
    DIM,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    SKY,
    Line,
    mark,
    number,
    spread,
    text,
    width,
)
from fitctl.tui.state import LoopView, Rms, Window, error_rms
from fitctl.tui.widgets.panel import Panel
from fitctl.tui.widgets.searchmap import search_lines

AXIS_COLUMNS = 6
STEPS = (1.0, 2.0, 5.0)
TIME_AXIS_FROM_ROWS = 9
TITLES = {True: "Search on the sky", False: "Pointing error"}


class Traces(Panel):
    """Azimuth above elevation: value now, RMS against the requirement, and the trace."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Both axes with equal room, and a time axis; without room for it the headings have its span.

        The scale is that of the present mode's errors; larger ones from before lie on the edge.
        """
        loop = self.state.loop
        if loop is None or self.state.newest is None:
            return []
        searching = loop.state.mode == "ACQUISITION"
        self.border_title = TITLES[searching]
        if searching:
            frame = self.state.newest.frame
            return search_lines(loop, frame.width_px if frame else 0, columns, rows)
        window, now_s = self.state.window, self.state.newest.time_s
        errors = loop.errors(max(window))
        since_s = loop.state.since_s
        rms = error_rms(errors, max(since_s, now_s - window.rms_s))
        span = f" · {window.trace_s:g} s"
        time_axis = rows >= TIME_AXIS_FROM_ROWS
        trace_rows = max(1, (rows - 2 - time_axis) // 2)
        in_mode_px = errors[errors[:, 0] >= max(since_s, now_s - window.trace_s), 1:]
        scale_px = axis_limit_px(in_mode_px, loop.state.requirement_px)
        lines: list[Line] = []
        for index, (name, colour, rms_px) in enumerate(
            (("az", SKY, rms.az_px), ("el", ORANGE, rms.el_px)), start=1
        ):
            now_px = float(errors[-1, index]) if len(errors) else math.nan
            heading = [text(f"{name} ", colour, bold=True)]
            heading.append(text(f"{number(now_px, '+.3f')} px", INK, bold=True))
            right = _rms_line(rms_px, rms, window, loop, columns - width(heading) - 1)
            if not time_axis and width(heading) + len(span) + width(right) < columns:
                heading.append(text(span, DIM))
            lines.append(spread(heading, right, columns))
            lines += trace_lines(
                errors[:, 0],
                errors[:, index],
                now_s=now_s,
                span_s=window.trace_s,
                limit_px=scale_px,
                requirement_px=loop.state.requirement_px,
                colour=colour,
                columns=columns,
                rows=trace_rows,
            )
        if time_axis:
            lines.append(_time_axis(columns, window.trace_s))
        return lines


def axis_limit_px(errors_px: NDArray[np.float64], requirement_px: float) -> float:
    """Half height of the traces: the least 1, 2 or 5 times a power of ten that holds all errors.

    Never less than twice the requirement, so that its band always shows.
    """
    finite = errors_px[np.isfinite(errors_px)]
    need = max(2 * requirement_px, 1.05 * float(np.abs(finite).max(initial=0.0)))
    decade = 10.0 ** math.floor(math.log10(need))
    return next(s * decade for s in (*STEPS, 10.0) if s * decade >= need * (1 - 1e-9))


def trace_lines(
    times_s: NDArray[np.float64],
    errors_px: NDArray[np.float64],
    *,
    now_s: float,
    span_s: float,
    limit_px: float,
    requirement_px: float,
    colour: str,
    columns: int,
    rows: int,
) -> list[Line]:
    """One trace with its scale at the left and dotted lines at zero and at ± the requirement."""
    across = columns - AXIS_COLUMNS - 1
    if across < 1:
        return [[] for _ in range(rows)]
    trace = braille.empty(rows, across)
    braille.envelope(trace, times_s, errors_px, now_s=now_s, span_s=span_s, limit=limit_px)
    guides = braille.empty(rows, across)
    braille.guide(guides, 0.0, limit_px, 6)
    for sign in (-1, 1):
        braille.guide(guides, sign * requirement_px, limit_px, 2)
    labels = _axis_labels(rows, limit_px, requirement_px)
    return [
        [label, text("▕", FAINT), *line]
        for label, line in zip(
            labels, braille.layered([(guides, GREEN), (trace, colour)]), strict=True
        )
    ]


def _axis_labels(rows: int, limit_px: float, requirement_px: float) -> list[Segment]:
    """What has no row of its own goes: first the ends of the scale, then the requirement."""
    labels = [text(" " * (AXIS_COLUMNS - 1))] * rows
    ends = ((limit_px, "+", DIM), (-limit_px, "−", DIM))
    band = ((requirement_px, "+", GREEN), (-requirement_px, "−", GREEN))
    for value, sign, colour in ((0.0, "", DIM), *band, *ends):
        y = min(rows - 1, int((1 - value / limit_px) / 2 * rows))
        if labels[y].text.isspace():
            labels[y] = text(f"{sign}{abs(value):g}".rjust(AXIS_COLUMNS - 1), colour)
    return labels


def _rms_line(rms_px: float, rms: Rms, window: Window, loop: LoopView, room: int) -> Line:
    """The RMS of one axis: in px, as a part of the requirement, and on the sky."""
    if math.isnan(rms_px):
        return [text("no star, no RMS", DIM)]
    requirement_px = loop.state.requirement_px
    sign = mark(good=rms_px <= requirement_px)
    part = rms_px / requirement_px
    ratio = f"{100 * part:.0f} %" if part < 10 else f"{part:.0f}×"
    named = f"{'of ' if part < 10 else ''}{requirement_px:g} px "
    on_sky = f"{1000 * loop.state.sky_arcsec_per_px * rms_px:.0f} mas"
    usual = rms.span_s >= 0.9 * window.rms_s and window.rms_s == 10.0
    head = [
        text("rms " if usual else f"rms {rms.span_s:.0f} s ", DIM),
        text(f"{rms_px:.3f}", INK, bold=True),
        text(f" {ratio} ", INK),
    ]
    sky = text(f" {on_sky}", DIM)
    forms = (
        [
            text(f"RMS {rms.span_s:.0f} s  ", DIM),
            text(f"{rms_px:.3f} px", INK, bold=True),
            text(f" = {ratio} {named}", INK),
            sign,
            text(f"  {on_sky} on the sky", DIM),
        ],
        [*head, text(named, INK), sign, sky],
        [*head, sign, sky],
        [*head, sign],
    )
    return next((form for form in forms if width(form) <= room), forms[-1])


def _time_axis(columns: int, span_s: float) -> Line:
    room = columns - AXIS_COLUMNS
    left, middle, right = f"−{span_s:g} s", f"−{span_s / 2:g} s", "now"
    row = left + middle.center(room - len(left) - len(right)) + right
    return [text(" " * AXIS_COLUMNS + row, DIM)]
