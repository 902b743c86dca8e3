"""Lines that may be aliases of faster ones: how far a design counteracts them.

On frames, a line and its alias look the same, but the mirror's response to an alias only adds to it. Most
designs respond to a line in either case. One that counteracts the line may respond more only as far as that
does no harm. A design that expects a part of the line's RMS responds less, and still removes most of the line
if the line is no alias.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis, Line
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
LESS_MOTION = 0.95
"""Of the mirror's motion as designs count with it, or less if the night shows less: so designs are compared
for aliases. Hysteresis beyond the rig file's takes some of the motion, and a design that amplifies a line gains
most by that: with 19 % instead of 15 %, one that should have left as much left 7 % more on the plant."""
LITTLE = 0.8
"""A design that leaves more than this part of what the present one leaves, if no line is an alias, gains too
little for a risk: if lines are aliases, it may leave no more even with `LEAST_MOTION`."""
LEAST_MOTION = 0.9
PARTS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.06, 0.0)
"""Of a line's RMS that a design may expect, the largest first."""
SIDES = (-1, 1)
"""Of the frame rate, on which the slowest aliases of a line are."""


class IfAliases(NamedTuple):
    """Residuals of two designs if lines are aliases, px, and whether the second does no harm then."""

    present_px: float
    learnt_px: float
    harmless: bool


def can_be_alias(line: Line, truth: Basis) -> bool:
    """Whether the rig may have a vibration as fast as the slowest that looks like this line.

    Not if another frame rate has shown that it is none, or where it is: above half the frame rate.
    """
    if line.frequency_hz > 0.5 / truth.period_s:
        return False
    if line.frequency_hz in truth.slow_lines_hz:
        return False
    return 1 / truth.period_s - line.frequency_hz <= truth.fastest_line_hz


def if_aliases(design: Design, truth: Basis, lines: tuple[Line, ...], mirror_gain: float) -> Floats:
    """Residuals if lines are aliases, px, shape (2,): of lines just below the frame rate, and just above it.

    The mirror's response is added to such a line. Its steps between frames also have a part at the line's own
    frequency, which makes the line larger or smaller, and differently on both sides.
    """
    nights = nights_if_aliases(dataclasses.replace(truth, mirror_gain=mirror_gain), lines)
    return np.array([linear_residual(design, night) for night in nights])


def nights_if_aliases(truth: Basis, lines: tuple[Line, ...]) -> list[Basis]:
    """The night, with these of its lines just below the frame rate, and just above it."""
    kept = _without(lines, truth)
    return [
        dataclasses.replace(
            kept, lines=kept.lines + tuple(alias_of(line, truth, side) for line in lines)
        )
        for side in SIDES
    ]


def alias_of(line: Line, truth: Basis, side: int) -> Line:
    """The line on this side of the frame rate that looks like it; the one below it if the other is too fast."""
    rate_hz = 1 / truth.period_s
    hz = rate_hz + side * line.frequency_hz
    if hz > truth.fastest_line_hz:
        hz = rate_hz - line.frequency_hz
    return at_frequency(line, hz)


def at_frequency(line: Line, frequency_hz: float) -> Line:
    """The line elsewhere, as wide in Hz."""
    damping = line.damping * line.frequency_hz / frequency_hz
    return Line(frequency_hz, damping, line.rms_px)


def both_if_aliases(
    present: Design, learnt: Design, truth: Basis, lines: tuple[Line, ...], shown_gain: float
) -> IfAliases:
    """What two designs leave if lines are aliases, in the case that speaks most against the learnt one.

    `shown_gain` is the mirror's gain that the night shows. Without lines, there is no such case, and the learnt
    design may leave as much as it will.
    """
    slow_present_px, slow_learnt_px = (linear_residual(one, truth) for one in (present, learnt))
    if not lines:
        return IfAliases(slow_present_px, slow_learnt_px, harmless=True)
    motions = [LESS_MOTION]
    if slow_learnt_px > LITTLE * slow_present_px:
        motions.append(LEAST_MOTION)
    cases: list[tuple[float, float]] = []
    for motion in motions:
        gain = min(motion * truth.mirror_gain, shown_gain)
        both_px = (if_aliases(one, truth, lines, gain).tolist() for one in (present, learnt))
        cases += zip(*both_px, strict=True)
    present_px, learnt_px = max(cases, key=lambda case: case[1] / case[0])
    return IfAliases(present_px, learnt_px, harmless=learnt_px <= present_px)


def safe_parts(truth: Basis, present: Design, shown_gain: float) -> Iterator[tuple[float, ...]]:
    """The parts of each line's RMS that a design may expect, so that it does no harm if lines are aliases.

    Each line for itself does no harm beside the present design, or beside one that does not expect the line if
    that leaves more. All that can be aliases together do none beside the present design; otherwise the largest
    parts are reduced, more and more: what a design does that must keep margins is for the caller to find out.
    """
    gain = min(LESS_MOTION * truth.mirror_gain, shown_gain)
    parts = [_safe_part(line, truth, present, gain) for line in truth.lines]
    suspects = tuple(line for line in truth.lines if can_be_alias(line, truth))
    limits_px = if_aliases(present, truth, suspects, gain)
    reductions = dict.fromkeys(  # each once: a limit above all parts changes none
        tuple(
            min(part, most) if line in suspects else part
            for line, part in zip(truth.lines, parts, strict=True)
        )
        for most in PARTS
    )
    *more, least = reductions
    for reduced in more:
        design = design_minimum_variance(expecting(reduced, truth))
        if (if_aliases(design, truth, suspects, gain) <= limits_px).all():
            yield reduced
    yield least


def expecting(parts: tuple[float, ...], truth: Basis) -> Basis:
    """A night with so much of each line's RMS."""
    lines = tuple(
        dataclasses.replace(line, rms_px=part * line.rms_px)
        for line, part in zip(truth.lines, parts, strict=True)
        if part > 0
    )
    return dataclasses.replace(truth, lines=lines)


def _safe_part(line: Line, truth: Basis, present: Design, gain: float) -> float:
    """Of one line, the others expected in full; 0 where no part would leave less than leaving it alone."""
    alone = design_minimum_variance(_without((line,), truth))
    alone_px = linear_residual(alone, truth)
    suspect = (line,) if can_be_alias(line, truth) else ()
    limits_px = np.maximum(*(if_aliases(one, truth, suspect, gain) for one in (alone, present)))
    for part in PARTS[:-1]:
        parts = tuple(part if other == line else 1.0 for other in truth.lines)
        design = design_minimum_variance(expecting(parts, truth))
        if linear_residual(design, truth) >= alone_px:
            continue
        if not suspect or (if_aliases(design, truth, suspect, gain) <= limits_px).all():
            return part
    return 0.0


def _without(lines: tuple[Line, ...], truth: Basis) -> Basis:
    return dataclasses.replace(
        truth, lines=tuple(line for line in truth.lines if line not in lines)
    )
