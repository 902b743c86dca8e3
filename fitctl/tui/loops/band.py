"""The loops side by side: mode, since when, and the RMS of each as a part of its requirement."""

from __future__ import annotations

import math

from fitctl.messages.modes import HOLDING, OPERATOR
from fitctl.tui.draw import braille
from fitctl.tui.inks import DIM, FAULT, GREEN, INK, ORANGE, PAPER, RED, SKY, WHITE
from fitctl.tui.look import (
    MODES,
    UNKNOWN_MODE,
    Line,
    Look,
    clickable,
    duration,
    pad,
    shorten,
    text,
    width,
)
from fitctl.tui.state import ConsoleState, LoopView, Rms, error_rms

CELL_FROM_COLUMNS = 30
SPARK_FROM_COLUMNS = 8
RMS_COLUMNS = 11
HOLDING_NAMES = {mode.name for mode in HOLDING}
STAR_LOST = "star lost"


def age(seconds: float) -> str:
    """How old something is, such as ``7 s``, in the largest unit that it fills twice."""
    for unit_s, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * unit_s:
            return f"{seconds / unit_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def has_failed(loop: LoopView) -> bool:
    """Whether the loop is SAFE because of a fault. False when a person stopped it."""
    return loop.state.mode == "SAFE" and loop.change is not None and loop.change.trigger == "FAULT"


def holds(loop: LoopView) -> bool:
    """Whether the loop is in a mode in which its requirement is to be met."""
    return loop.state.mode in HOLDING_NAMES


def mode_look(loop: LoopView | None) -> Look:
    """Sign and colour of the loop's mode; SAFE after a fault has those of an error."""
    if loop is None:
        return UNKNOWN_MODE
    if has_failed(loop):
        return Look("✗", FAULT.dark)
    return MODES.get(loop.state.mode, UNKNOWN_MODE)


def mode_chip(state: ConsoleState, loop: LoopView | None) -> Line:
    """Sign and mode on the mode's colour; of old data the mode that was, and its age, on grey."""
    if loop is None:
        return [text(" NO DATA ", PAPER, on=DIM, bold=True)]
    look, mode = mode_look(loop), loop.state.mode
    if state.stale:
        return [text(f" {mode}, {age(state.silent_s)} ago ", PAPER, on=DIM, bold=True)]
    return [text(f" {look.symbol} {mode} ", PAPER, on=look.colour, bold=True)]


def why_safe(state: ConsoleState, loop: LoopView) -> str:
    """Why and by whom the loop is SAFE, in a word or two; empty in other modes."""
    if loop.state.mode != "SAFE":
        return ""
    if has_failed(loop):
        return "fault"
    by_command = loop.change is not None and loop.change.reason == OPERATOR
    if not by_command:
        return "stopped"
    stopped_by = state.newest.stopped_by if state.newest else ""
    return f"stopped by {stopped_by or 'operator'}"


def present_rms(state: ConsoleState, loop: LoopView) -> Rms:
    """RMS of the loop's error over the chosen window, from its present mode alone."""
    now_s = state.newest.time_s if state.newest else math.nan
    window_s = state.window.rms_s
    return error_rms(loop.errors(window_s), max(loop.state.since_s, now_s - window_s))


def part_of_requirement(state: ConsoleState, loop: LoopView) -> float:
    """RMS of the worse axis as a part of the requirement; not-a-number without a star or beam."""
    rms = present_rms(state, loop)
    return max(rms.az_px, rms.el_px) / loop.state.requirement_px


def _condition(state: ConsoleState, loop: LoopView, columns: int) -> Line:
    """What there is to say of a loop in the columns that are left: why it does not hold, or its RMS."""
    if loop.state.search_again is not None:
        return [text(_that_fits((f"▲ {STAR_LOST}", "▲ lost"), columns), ORANGE, bold=True)]
    reason = why_safe(state, loop)
    if reason:
        by = reason.removeprefix("stopped ")
        short = _that_fits((reason, by, shorten(reason, columns)), columns)
        return [text(short, RED if has_failed(loop) else INK)]
    if loop.state.waits_for:
        return [text(_that_fits((f"waits: {loop.state.waits_for}", "waits"), columns), INK)]
    part = part_of_requirement(state, loop)
    if math.isnan(part):
        return [text("no RMS", DIM)]
    figure = f"{100 * part:.0f} %" if part < 10 else f"{part:.0f}×"
    good = part <= 1
    sign = text(" ✓" if good else " ▲", GREEN if good else ORANGE, bold=True)
    label = [text("RMS ", DIM)] if columns >= RMS_COLUMNS else []
    line = [*label, text(f"{figure:>5}", INK, bold=True)]
    return [*line, sign] if holds(loop) else line


def _that_fits(forms: tuple[str, ...], columns: int) -> str:
    """The first form that fits; otherwise the last one."""
    return next((form for form in forms if len(form) <= columns), forms[-1])


def loop_cell(state: ConsoleState, loop: LoopView, columns: int, names: int) -> Line:
    """One loop: its name in `names` columns, mode, time in mode, and condition; a click chooses it."""
    chosen = loop.state.name == state.shown
    line: Line = [
        text("▸" if chosen else " ", SKY, bold=True),
        text(f"{loop.state.name:<{names}} ", WHITE if chosen else INK, bold=chosen),
        *pad(
            mode_chip(state, loop),
            max(width(mode_chip(state, each)) for each in state.loops.values()),
        ),
    ]
    if not state.stale and state.newest is not None:
        since = f" {duration(state.newest.time_s - loop.state.since_s)}"
        condition = _condition(state, loop, columns - width(line) - len(since) - 2)
        if width(line) + len(since) + width(condition) + 2 > columns:
            since, condition = "", _condition(state, loop, columns - width(line) - 2)
        line += [text(since, INK), text(" "), *condition]
    return clickable(pad(line, columns), f"app.show_loop({loop.state.name!r})")


def _names(state: ConsoleState) -> int:
    return max(len(name) for name in state.loops)


def loop_rows(state: ConsoleState, columns: int) -> list[Line]:
    """All loops in one row where it has room for them; else a row each, with a sparkline of its error."""
    loops, names = list(state.loops.values()), _names(state)
    each = columns // len(loops)
    if each >= CELL_FROM_COLUMNS:
        return [[part for loop in loops for part in loop_cell(state, loop, each, names)]]
    most = min(columns, names + 34)
    return [
        [*loop_cell(state, loop, most, names), *sparkline(state, loop, columns - most)]
        for loop in loops
    ]


def sparkline(state: ConsoleState, loop: LoopView, columns: int) -> Line:
    """The error of both axes over the window of the traces; its height is twice the requirement."""
    if columns < SPARK_FROM_COLUMNS or state.newest is None:
        return []
    span_s = state.window.trace_s
    errors = loop.errors(span_s)
    dots = braille.empty(1, columns)
    for axis in (1, 2):
        braille.envelope(
            dots,
            errors[:, 0],
            errors[:, axis],
            now_s=state.newest.time_s,
            span_s=span_s,
            limit=2 * loop.state.requirement_px,
        )
    return braille.layered([(dots, DIM if state.stale else mode_look(loop).colour)])[0]
