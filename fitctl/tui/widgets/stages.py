"""Both stages: the mirror on its diamond with its trail, its stacks, the siderostat and its limits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from textual.strip import Strip

from fitctl.logging.records import MetrologyTick, Tick
from fitctl.tui.draw import braille
from fitctl.tui.inks import DIM, FAINT, GREEN, INK, ORANGE, PAPER, RED, SKY, YELLOW
from fitctl.tui.look import Line, bar, faded, in_columns, number, pad, text, width
from fitctl.tui.state import LoopView
from fitctl.tui.widgets.panel import Panel

HIGH_RANGE = 0.8
NUMBER_COLUMNS = 28
NAME_COLUMNS = 6
STACKS_LIMIT_FROM_COLUMNS = 38
TRAIL_S = 10.0
OLD_FROM_S = 1.0


class Stages(Panel):
    """The diamond at the left, numbers at the right; of a metrology loop photodiodes and siderostat."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """As many rows of numbers as there is room for, the weightiest first; in greys while nothing ticks."""
        loop, newest = self.state.loop, self.state.newest
        record = (loop.beam or loop.tick) if loop else None
        lines = self._numbers(columns, rows)
        is_old = newest and record and newest.time_s - record.time_s > OLD_FROM_S
        return list(map(faded, lines)) if is_old else lines

    def _numbers(self, columns: int, rows: int) -> list[Line]:
        loop = self.state.loop
        if loop is not None and loop.beam is not None:
            self.border_title = "Photodiodes and siderostat"
            return _of_beam(loop, loop.beam, columns)[:rows]
        self.border_title = "Mirror and siderostat"
        tick = loop.tick if loop else None
        if loop is None or tick is None:
            return []
        trail = trail_on_diamond(loop, tick)
        side = min(rows, max(3, (columns - NUMBER_COLUMNS) // 2 - 1))
        picture = diamond_lines(tick, side, trail)
        left = width(picture[0]) + 1
        above = (rows - len(picture)) // 2
        numbers = _numbers(loop, tick, columns - left, rows)[:rows]
        numbers += [[] for _ in range(rows - len(numbers))]
        return in_columns([*([] for _ in range(above)), *picture], left, numbers)


def _of_beam(loop: LoopView, beam: MetrologyTick, columns: int) -> list[Line]:
    """Where the beam is, the light on each photodiode, and the siderostat, the weightiest first."""
    diodes_v = (
        ("az + −", beam.diode_az_plus_v, beam.diode_az_minus_v),
        ("el + −", beam.diode_el_plus_v, beam.diode_el_minus_v),
    )
    return [
        _row("beam", _pair(beam.beam_az_arcsec, beam.beam_el_arcsec, "+.2f"), "″"),
        _siderostat(loop, beam, columns),
        _to_go(beam),
        *(_row(name, _pair(plus_v, minus_v, ".2f"), "V") for name, plus_v, minus_v in diodes_v),
        _row("rate", _pair(beam.rate_az_arcsec_s, beam.rate_el_arcsec_s, "+.1f"), "″/s"),
    ]


def _to_go(tick: Tick | MetrologyTick) -> Line:
    """How far the siderostat is from its set-point."""
    az_rad = tick.siderostat_setpoint_az_rad - tick.siderostat_az_rad
    el_rad = tick.siderostat_setpoint_el_rad - tick.siderostat_el_rad
    return _row("to go", _pair(1e3 * az_rad, 1e3 * el_rad, "+.1f"), "mrad")


def working_point(tick: Tick) -> tuple[float, float]:
    """Where the mirror is on its diamond; the corners are at 1. The range itself is not in a tick."""
    used = abs(tick.fsm_az_rad) + abs(tick.fsm_el_rad)
    if not used > 0 or not math.isfinite(tick.fsm_range_fraction):
        return 0.0, 0.0
    scale = min(tick.fsm_range_fraction, 1.0) / used
    return tick.fsm_az_rad * scale, tick.fsm_el_rad * scale


def trail_on_diamond(loop: LoopView, tick: Tick) -> NDArray[np.float64]:
    """Where the mirror was in the last `TRAIL_S`, shape (n, 2); the corners are at 1."""
    past = loop.past.since(tick.time_s - TRAIL_S, "fsm_az_rad", "fsm_el_rad")
    limits = loop.state.limits
    return past / limits.fsm_range_rad if limits else np.empty((0, 2))


def diamond_lines(tick: Tick, rows: int, trail: NDArray[np.float64]) -> list[Line]:
    """The mirror's range ``|az| + |el| <= 1``, trail and working point; about twice as many columns as rows."""
    columns = 2 * rows + 1
    az, el = working_point(tick)
    x, y = round((az + 1) / 2 * (columns - 1)), round((1 - el) / 2 * (rows - 1))
    sign, colour = (
        ("✗", RED) if tick.fsm_saturated else ("●", _range_colour(tick.fsm_range_fraction))
    )
    way = braille.empty(rows, columns)
    braille.scatter(way, (trail[:, 0] + 1) / 2, (trail[:, 1] + 1) / 2)
    lines = braille.layered([(braille.diamond(rows, columns), DIM), (way, SKY)])
    line = Strip(pad(lines[y], columns))
    lines[y] = [*line.crop(0, x), text(sign, colour, bold=True), *line.crop(x + 1)]
    return lines


def _numbers(loop: LoopView, tick: Tick, columns: int, rows: int) -> list[Line]:
    mirror = _mirror_bar(tick, columns)
    stacks_v = (tick.stack1_v, tick.stack2_v, tick.stack3_v)
    stacks = _row("D/A", " ".join(number(v, ".2f") for v in stacks_v), "V")
    siderostat = _siderostat(loop, tick, columns)
    behind = _to_go(tick)
    if rows <= 4:
        last = _search_bar(tick, columns) if tick.mode == "ACQUISITION" else behind
        return [mirror, stacks, siderostat, last]
    mirror_urad = (1e6 * tick.fsm_az_rad, 1e6 * tick.fsm_el_rad)
    lines = [mirror, _row("tilt", _pair(*mirror_urad, "+.1f"), "µrad")]
    if any(loop.state.bias_offset_urad):
        lines.append(_row("offset", _pair(*loop.state.bias_offset_urad, "+.1f"), "µrad"))
    lines.append(stacks)
    if loop.piezo is not None:
        measured_v = (loop.piezo.stack1_v, loop.piezo.stack2_v, loop.piezo.stack3_v)
        unit = f"V, limit {loop.piezo.limit_v:g}" if columns >= STACKS_LIMIT_FROM_COLUMNS else "V"
        lines.append(_row("stacks", " ".join(number(v, ".1f") for v in measured_v), unit))
    lines += [siderostat, behind]
    return [*lines, _search_bar(tick, columns)] if tick.mode == "ACQUISITION" else lines


def _row(name: str, values: str, unit: str) -> Line:
    return [text(name.ljust(NAME_COLUMNS), DIM), text(values.rjust(17), INK), text(f" {unit}", DIM)]


def _pair(az: float, el: float, form: str) -> str:
    return f"{number(az, form):>8} {number(el, form):>8}"


def _siderostat(loop: LoopView, tick: Tick | MetrologyTick, columns: int) -> Line:
    """On the sky, beside how far it may go, in the widest form that has room."""
    az_arcsec, el_arcsec = tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec
    wide = _pair(az_arcsec, el_arcsec, "+.1f").rjust(17)
    limits = loop.state.limits
    if limits is None:
        return _row("sider", wide, "″")
    short = f"±{limits.siderostat_travel_sky_arcsec:g}″"
    used = max(abs(az_arcsec), abs(el_arcsec)) / limits.siderostat_travel_sky_arcsec
    high = used > HIGH_RANGE
    sign = "!" if high else " "
    close = f"{number(az_arcsec, '+.1f'):>6}{number(el_arcsec, '+.1f'):>7}"
    limit = f"of {short}"
    forms = (
        (wide, f" ″{sign}", limit),
        (close, sign, limit),
        (close, sign, short),
        (wide, sign, "″"),
    )
    room = columns - NAME_COLUMNS
    values, mark, rest = next((form for form in forms if len("".join(form)) <= room), forms[-1])
    return [
        text("sider".ljust(NAME_COLUMNS), DIM),
        text(values, ORANGE if high else INK, bold=high),
        text(mark, ORANGE if high else DIM, bold=high),
        text(rest, DIM),
    ]


def _range_colour(fraction: float) -> str:
    return ORANGE if fraction > HIGH_RANGE else GREEN


def _mirror_bar(tick: Tick, columns: int) -> Line:
    fraction = tick.fsm_range_fraction
    if tick.fsm_saturated:
        return [text("FSM    ", DIM), text(" ✗ SATURATED ", PAPER, on=RED, bold=True)]
    high = fraction > HIGH_RANGE
    percent = f"{number(100 * fraction, '3.0f')} %{'!' if high else ''}"
    return [
        text("FSM    ", DIM),
        text(percent, ORANGE if high else INK, bold=True),
        text(" "),
        *bar(fraction, max(4, columns - 14), _range_colour(fraction)),
    ]


def _search_bar(tick: Tick, columns: int) -> Line:
    percent = f"{number(100 * tick.search_progress, '3.0f')} %"
    return [
        text("search ", YELLOW),
        text(percent, INK, bold=True),
        text(" "),
        *bar(tick.search_progress, max(4, columns - 13), YELLOW, FAINT),
    ]
