"""Lines that may be aliases of faster ones: how far a design counteracts them.

On frames, a line and its alias look the same, but the mirror's response to an alias only adds to it. Most
designs respond to a line in either case. One that counteracts the line may respond more only as far as that
does no harm. A design that expects a part of the line's RMS responds less, and still removes most of the line
if the line is no alias.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from fitctl.controllers.design.basis import Basis, Line
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.pair import Design

MOST_IF_ALIAS = 1.02
"""If lines are aliases, a design may leave at most so much of what it would leave without expecting them, or
of what the present design leaves."""
PARTS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.06, 0.0)
"""Of a line's RMS that a design may expect, the largest first."""


def can_be_alias(line: Line, truth: Basis) -> bool:
    """Whether the rig may have a vibration as fast as the slowest that looks like this line."""
    return 1 / truth.period_s - line.frequency_hz <= truth.fastest_line_hz


def if_aliases(design: Design, truth: Basis, lines: tuple[Line, ...]) -> float:
    """Residual if lines are aliases: they stay, and the mirror's response is added to them."""
    power_px2 = linear_residual(design, _without(lines, truth)) ** 2
    for line in lines:
        omega_rad_s = np.array([2 * math.pi * line.frequency_hz])
        loop = sampled_response(design, truth)(omega_rad_s)[0]
        power_px2 += line.rms_px**2 * (1 + abs(loop / (1 + loop)) ** 2)
    return math.sqrt(power_px2)


def safe_parts(truth: Basis, present: Design) -> tuple[float, ...]:
    """The part of each line's RMS that a design may expect, so that it does no harm if lines are aliases.

    Each line for itself does no harm beside a design that does not expect the line. All that can be aliases
    together do none beside the present design; otherwise the largest parts are reduced.
    """
    parts = [_safe_part(line, truth) for line in truth.lines]
    suspects = tuple(line for line in truth.lines if can_be_alias(line, truth))
    limit_px = MOST_IF_ALIAS * if_aliases(present, truth, suspects)
    reductions = dict.fromkeys(  # each once: a limit above all parts changes none
        tuple(
            min(part, most) if line in suspects else part
            for line, part in zip(truth.lines, parts, strict=True)
        )
        for most in PARTS
    )
    for reduced in reductions:
        design = design_minimum_variance(expecting(reduced, truth))
        if if_aliases(design, truth, suspects) <= limit_px:
            break
    return reduced


def expecting(parts: tuple[float, ...], truth: Basis) -> Basis:
    """A night with so much of each line's RMS."""
    lines = tuple(
        dataclasses.replace(line, rms_px=part * line.rms_px)
        for line, part in zip(truth.lines, parts, strict=True)
        if part > 0
    )
    return dataclasses.replace(truth, lines=lines)


def _safe_part(line: Line, truth: Basis) -> float:
    """Of one line, the others expected in full; 0 where no part would leave less than leaving it alone."""
    alone = design_minimum_variance(_without((line,), truth))
    alone_px = linear_residual(alone, truth)
    limit_px = MOST_IF_ALIAS * if_aliases(alone, truth, (line,))
    suspect = can_be_alias(line, truth)
    for part in PARTS[:-1]:
        parts = tuple(part if other == line else 1.0 for other in truth.lines)
        design = design_minimum_variance(expecting(parts, truth))
        if linear_residual(design, truth) >= alone_px:
            continue
        if not suspect or if_aliases(design, truth, (line,)) <= limit_px:
            return part
    return 0.0


def _without(lines: tuple[Line, ...], truth: Basis) -> Basis:
    return dataclasses.replace(
        truth, lines=tuple(line for line in truth.lines if line not in lines)
    )
