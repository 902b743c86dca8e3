"""Both stages: the fast steering mirror on its diamond, its stacks, the siderostat, the search."""

from __future__ import annotations

import math

from rich.segment import Segment

from fitctl.logging.records import Tick
from fitctl.tui.draw import braille
from fitctl.tui.look import (
    DIM,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    RED,
    YELLOW,
    Line,
    bar,
    number,
    pad,
    style,
    text,
    width,
)
from fitctl.tui.state import LoopView
from fitctl.tui.widgets.panel import Panel

HIGH_RANGE = 0.8
NUMBER_COLUMNS = 28
LIMIT_FROM_COLUMNS = 34


class Stages(Panel):
    """The diamond at the left, numbers at the right."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """As many rows of numbers as there is room for, the weightiest first."""
        loop = self.state.loop
        tick = loop.tick if loop else None
        if loop is None or tick is None:
            return []
        picture = diamond_lines(tick, min(rows, max(3, (columns - NUMBER_COLUMNS) // 2 - 1)))
        left = width(picture[0]) + 1
        above = (rows - len(picture)) // 2
        picture = [*([] for _ in range(above)), *picture]
        picture += [[] for _ in range(rows - len(picture))]
        numbers = _numbers(loop, tick, columns - left, rows)
        numbers += [[] for _ in range(rows - len(numbers))]
        return [
            [*pad(drawn, left), *beside]
            for drawn, beside in zip(picture, numbers[:rows], strict=True)
        ]


def working_point(tick: Tick) -> tuple[float, float]:
    """Where the mirror is on its diamond; the corners are at 1. The range itself is not in a tick."""
    used = abs(tick.fsm_az_rad) + abs(tick.fsm_el_rad)
    if not used > 0 or not math.isfinite(tick.fsm_range_fraction):
        return 0.0, 0.0
    scale = min(tick.fsm_range_fraction, 1.0) / used
    return tick.fsm_az_rad * scale, tick.fsm_el_rad * scale


def diamond_lines(tick: Tick, rows: int) -> list[Line]:
    """The mirror's range ``|az| + |el| <= 1`` with the working point; about twice as many columns as rows."""
    columns = 2 * rows + 1
    az, el = working_point(tick)
    point = (
        round((az + 1) / 2 * (columns - 1)),
        round((1 - el) / 2 * (rows - 1)),
    )
    look = ("✗", RED) if tick.fsm_saturated else ("●", _range_colour(tick.fsm_range_fraction))
    lines: list[Line] = []
    for y, codes in enumerate(braille.cells(braille.diamond(rows, columns)).tolist()):
        row = "".join(map(chr, codes))
        if y == point[1]:
            before, after = row[: point[0]], row[point[0] + 1 :]
            lines.append(
                [
                    Segment(before, style(DIM)),
                    text(look[0], look[1], bold=True),
                    Segment(after, style(DIM)),
                ]
            )
        else:
            lines.append([Segment(row, style(DIM))])
    return lines


def _numbers(loop: LoopView, tick: Tick, columns: int, rows: int) -> list[Line]:
    mirror = _mirror_bar(tick, columns)
    stacks_v = (tick.stack1_v, tick.stack2_v, tick.stack3_v)
    stacks = _row("D/A", " ".join(number(v, ".2f") for v in stacks_v), "V")
    sky_arcsec = (tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec)
    siderostat = _row("sider.", _pair(*sky_arcsec, "+.1f"), "″")
    behind_rad = (
        tick.siderostat_setpoint_az_rad - tick.siderostat_az_rad,
        tick.siderostat_setpoint_el_rad - tick.siderostat_el_rad,
    )
    behind = _row("to go", _pair(1e3 * behind_rad[0], 1e3 * behind_rad[1], "+.1f"), "mrad")
    last = _search_bar(tick, columns) if tick.mode == "ACQUISITION" else behind
    if rows <= 4:
        return [mirror, stacks, siderostat, last]
    mirror_urad = (1e6 * tick.fsm_az_rad, 1e6 * tick.fsm_el_rad)
    lines = [mirror, _row("tilt", _pair(*mirror_urad, "+.1f"), "µrad"), stacks]
    if loop.piezo is not None:
        measured_v = (loop.piezo.stack1_v, loop.piezo.stack2_v, loop.piezo.stack3_v)
        unit = f"V, limit {loop.piezo.limit_v:g}" if columns >= LIMIT_FROM_COLUMNS else "V"
        lines.append(_row("stacks", " ".join(number(v, ".1f") for v in measured_v), unit))
    lines += [siderostat, behind]
    return [*lines, _search_bar(tick, columns)] if tick.mode == "ACQUISITION" else lines


def _row(name: str, values: str, unit: str) -> Line:
    return [text(name.ljust(6), DIM), text(values.rjust(17), INK), text(f" {unit}", DIM)]


def _pair(az: float, el: float, form: str) -> str:
    return f"{number(az, form):>8} {number(el, form):>8}"


def _range_colour(fraction: float) -> str:
    return ORANGE if fraction > HIGH_RANGE else GREEN


def _mirror_bar(tick: Tick, columns: int) -> Line:
    fraction = tick.fsm_range_fraction
    if tick.fsm_saturated:
        return [text("FSM    ", DIM), text(" ✗ SATURATED ", "#0b0e13", on=RED, bold=True)]
    percent = f"{number(100 * fraction, '3.0f')} %"
    return [
        text("FSM    ", DIM),
        text(percent, INK, bold=True),
        text(" "),
        *bar(fraction, max(4, columns - 13), _range_colour(fraction)),
    ]


def _search_bar(tick: Tick, columns: int) -> Line:
    percent = f"{number(100 * tick.search_progress, '3.0f')} %"
    return [
        text("search ", YELLOW),
        text(percent, INK, bold=True),
        text(" "),
        *bar(tick.search_progress, max(4, columns - 13), YELLOW, FAINT),
    ]
