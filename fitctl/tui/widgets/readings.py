"""The Devices screen's two lists: devices with their links, and every reading beside its limits."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from rich.segment import Segment

from fitctl.config import QUANTITIES
from fitctl.logging.records import DeviceHealth
from fitctl.messages.telemetry import TrippedInterlock, Watched
from fitctl.tui.draw import braille
from fitctl.tui.inks import DIM, GREEN, INK, ORANGE, RED, SKY
from fitctl.tui.look import (
    DEVICES,
    Line,
    as_markup,
    bar,
    duration,
    in_columns,
    number,
    shorten,
    spread,
    text,
    wall,
    width,
)
from fitctl.tui.state import ConsoleState, LoopView
from fitctl.tui.widgets.choice import Choice
from fitctl.tui.widgets.events import event_lines
from fitctl.tui.widgets.panel import Panel

NAME_COLUMNS = 21
# What a device's link is measured by: a quantity, its unit as people write it, and what it is in it.
LINKS = {
    "camera": ("frame_late_s", "frame late", 1e3, "ms"),
    "siderostat": ("amplifier_round_trip_periods", "round trip", 100.0, "% of period"),
    "D/A": ("dac_round_trip_s", "round trip", 1e3, "ms"),
}
UNITS = {"s": "s", "bytes": "GB", "rad": "rad", "v": "V", "fraction": "%", "periods": "periods"}
ILL_FIRST = ("fault", "closed", "ok")
USED_STEPS = 20  # a reading moves in its list when it has used a twentieth more of its limit
FACTORS = {"bytes": 1e-9, "fraction": 100.0}


def in_units(quantity: str, value: float | None) -> str:
    """A value as people read it, by the unit at the end of its quantity's name."""
    if value is None:
        return ""
    suffix = quantity.rpartition("_")[2]
    return f"{_scaled(suffix, value)} {UNITS.get(suffix, '')}".rstrip()


def _scaled(suffix: str, value: float) -> str:
    return number(FACTORS.get(suffix, 1.0) * value, ".3g")


class DeviceList(Choice):
    """A device a row: state, name, link, what it reports, its address."""

    def rows(self, columns: int) -> list[Line]:
        """All devices of the rig."""
        devices = self.devices()
        names = max((len(device.device) for device in devices), default=0) + 1
        return [self._row(device, names, columns) for device in devices]

    def names(self) -> list[str]:
        """Of the devices."""
        return [device.device for device in self.devices()]

    def devices(self) -> list[DeviceHealth]:
        """Ill ones first, otherwise as telemetry has them."""
        devices = self.state.newest.devices if self.state.newest else []
        return sorted(devices, key=lambda device: ILL_FIRST.index(device.state))

    def now(self) -> DeviceHealth | None:
        """The chosen device."""
        known = self.devices()
        return known[min(self.chosen, len(known) - 1)] if known else None

    def _row(self, device: DeviceHealth, name_columns: int, columns: int) -> Line:
        look = DEVICES[device.state]
        line = [
            text(f"{look.symbol} ", look.colour, bold=True),
            text(device.device.ljust(name_columns), INK, bold=True),
            text(f"{device.state:<7}", look.colour),
            text(f"{self.link_of(device):<29}", INK),
        ]
        report = device.detail if device.state == "fault" else f"{device.identity}  {device.detail}"
        rest = columns - width(line)
        return [*line, text(shorten(f"{report}  {device.endpoint}", rest), DIM)]

    def link_of(self, device: DeviceHealth) -> str:
        """How quick its link is, in words; empty where it is not measured."""
        loop_name, _, part = device.device.rpartition(" ")
        loop = self.state.loops.get(loop_name) or self.state.loop
        if loop is None or self.state.newest is None or device.state == "closed":
            return ""
        if part == "piezo" and loop.piezo is not None:
            return f"answered {self.state.newest.time_s - loop.piezo.time_s:.1f} s ago"
        if part not in LINKS:
            return ""
        quantity, name, factor, unit = LINKS[part]
        row = next((row for row in loop.state.watched if row.quantity == quantity), None)
        if row is None or math.isnan(row.value):
            return ""
        return f"{name} {number(factor * row.value, '.1f')} {unit}"


class Readings(Choice):
    """Every row of the table of interlocks: what is measured, within what, and how far that is."""

    def watched(self) -> list[Watched]:
        """Of the loop on the screen: tripped ones first, then those nearest to their limits."""
        loop = self.state.loop
        if loop is None:
            return []
        tripped = {trip.name for trip in loop.state.interlocks}
        return sorted(
            loop.state.watched, key=lambda row: (row.name not in tripped, *_distance(row))
        )

    def names(self) -> list[str]:
        """Of the interlocks."""
        return [row.name for row in self.watched()]

    def head(self, columns: int) -> list[Line]:
        """Names of the columns."""
        return [
            [text(f"  {'interlock':<{NAME_COLUMNS}}{'reads':>14}  {'allowed':<22}age    then", DIM)]
        ]

    def rows(self, columns: int) -> list[Line]:
        """One line each; what is tripped comes in its action's colour."""
        loop = self.state.loop
        if loop is None:
            return []
        tripped = {trip.name for trip in loop.state.interlocks}
        return [_reading(row, columns, tripped=row.name in tripped) for row in self.watched()]

    def now(self) -> Watched | None:
        """The chosen row."""
        rows = self.watched()
        return rows[self.chosen] if self.chosen < len(rows) else None


class Detail(Panel):
    """All about the chosen row of the list that has the focus, and its course.

    Of a reading, its values beside its limits; of a device, the events that name it.
    """

    every: ClassVar[int] = 5

    def __init__(
        self, state: ConsoleState, title: str, devices: DeviceList, readings: Readings
    ) -> None:
        super().__init__(state, title)
        self._devices = devices
        self._readings = readings

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Words at the left, the course at the right."""
        loop, row, device = self.state.loop, self._readings.now(), self._devices.now()
        if self._readings.has_focus and loop is not None and row is not None:
            self.border_title = as_markup(row.name)
            words = reading_lines(loop, row)
            course = self._course(loop, row, columns // 2, rows)
        elif device is not None:
            self.border_title = as_markup(device.device)
            words = device_lines(self._devices, device)
            course = self._events_of(device, columns // 2, rows)
        else:
            return []
        left = columns - columns // 2 - 2
        lines = [
            [text(f"{name if first else '':<11}", DIM), text(piece, INK)]
            for name, content in words
            for first, piece in _wrapped(content, left - 12)
        ]
        return in_columns(lines[:rows], left + 2, course)

    def _course(self, loop: LoopView, row: Watched, columns: int, rows: int) -> list[Line]:
        """The values that were kept, with dotted lines at the limits, and their scale."""
        kept = np.array(loop.readings.get(row.name, ()), dtype=float).reshape(-1, 2)
        values = kept[np.isfinite(kept[:, 1])]
        if len(values) < 2 or rows < 4:
            return [[text("no course yet", DIM)]]
        limits = [limit for limit in (row.low, row.high) if limit is not None]
        least = min([*limits, float(values[:, 1].min())])
        most = max([*limits, float(values[:, 1].max())])
        middle, half = (most + least) / 2, max(0.55 * (most - least), 1e-12)
        now_s, span_s = float(values[-1, 0]), max(float(np.ptp(values[:, 0])), 1.0)
        trace, guides = braille.empty(rows - 2, columns), braille.empty(rows - 2, columns)
        braille.envelope(
            trace, values[:, 0], values[:, 1] - middle, now_s=now_s, span_s=span_s, limit=half
        )
        for limit in limits:
            braille.guide(guides, limit - middle, half, 3)
        scale = f"{in_units(row.quantity, least)} to {in_units(row.quantity, most)}"
        return [
            [text(f"limits dotted; {scale}", DIM)],
            *braille.layered([(guides, ORANGE), (trace, SKY)]),
            spread(
                [text(f"−{duration(span_s)}", DIM)],
                [text(wall(self.state.wall_s(now_s)), DIM)],
                columns,
            ),
        ]

    def _events_of(self, device: DeviceHealth, columns: int, rows: int) -> list[Line]:
        """What was reported of a device, newest first."""
        words = device.device.split()
        lines: list[Line] = []
        for event in self.state.events:
            said = f"{event.source} {event.message}"
            if all(word in said for word in words):
                lines += event_lines(event, self.state.wall_s(event.time_s), columns)
            if len(lines) >= rows:
                break
        return lines or [[text("no event mentions it", DIM)]]


def _wrapped(content: str, columns: int) -> Iterator[tuple[bool, str]]:
    """Pieces of a text, and whether each is the first."""
    for number_, piece in enumerate(textwrap.wrap(content, max(10, columns)) or [""]):
        yield number_ == 0, piece


def _reading(row: Watched, columns: int, *, tripped: bool) -> Line:
    sign, colour = ("✓", GREEN)
    if tripped:
        sign, colour = ("▲", ORANGE) if row.action == "warn" else ("✗", RED)
    elif not row.judged:
        sign, colour = ("·", DIM)
    age = f"{row.age_s:.1f} s" if row.age_s < 100 else "old" if row.age_s > 0 else ""
    ink = colour if tripped else INK if row.judged else DIM
    line = [
        text(f"{sign} ", colour, bold=True),
        text(f"{row.name:<{NAME_COLUMNS}}", ink),
        text(f"{in_units(row.quantity, row.value):>14}  ", ink, bold=tripped),
        text(f"{_allowed(row):<22}", DIM),
        text(f"{age:<7}", DIM),
        text(f"{row.action:<8}", DIM),
    ]
    room = columns - width(line) - 2
    return [*line, *_gauge(row, room, colour if tripped else SKY)] if room >= 8 else line


def _allowed(row: Watched) -> str:
    low, high = in_units(row.quantity, row.low), in_units(row.quantity, row.high)
    if low and high:
        return f"{low.partition(' ')[0]} to {high}"
    return f"≤ {high}" if high else f"≥ {low}" if low else f"age ≤ {row.stale_s:g} s"


def limit_used(row: Watched) -> float:
    """How much of what is allowed is used, 1.0 at the limit; not-a-number without a value or a limit."""
    value, low, high = row.value, row.low, row.high
    used = []
    if high is not None and high > 0:
        used.append(abs(value) / high if low is None or low < 0 else value / high)
    if low is not None and low > 0:
        used.append(low / value if value > 0 else math.inf)
    return max(used, default=math.nan)


def _distance(row: Watched) -> tuple[bool, int, str]:
    """The order of a list: what is judged first, then by how much is used, in steps that rarely change."""
    used = limit_used(row)
    steps = -math.floor(USED_STEPS * min(used, 10.0)) if not math.isnan(used) else 0
    return not row.judged, steps, row.name


def _gauge(row: Watched, columns: int, colour: str) -> list[Segment]:
    """How much of what is allowed is used."""
    used = limit_used(row)
    return bar(used, min(columns, 30), colour) if math.isfinite(used) else []


def device_lines(devices: DeviceList, device: DeviceHealth) -> list[tuple[str, str]]:
    """All about a device, as names and values."""
    return [
        ("state", device.state),
        ("endpoint", device.endpoint),
        ("identity", device.identity or "no reading yet"),
        ("reports", device.detail),
        ("link", devices.link_of(device) or "no reading"),
        ("since", wall(devices.state.wall_s(device.time_s)) + " (last report)"),
        ("actions", "r Recover from SAFE: reconnects, resets faults · b Standby from OFF · o Off"),
    ]


def reading_lines(loop: LoopView, row: Watched) -> list[tuple[str, str]]:
    """All about a row of the table of interlocks."""
    quantity = QUANTITIES[row.quantity]
    trip = next((trip for trip in loop.state.interlocks if trip.name == row.name), None)
    stale = f"or not measured for {row.stale_s:g} s" if row.stale_s is not None else ""
    return [
        ("quantity", f"{row.quantity}: {quantity.meaning}"),
        ("of", quantity.part),
        ("reads", f"{in_units(row.quantity, row.value)}, {row.age_s:.2f} s old"),
        ("allowed", f"{_allowed(row)} {stale}".rstrip()),
        ("judged now", "yes" if row.judged else f"not in {loop.state.mode}"),
        ("then", row.action),
        ("tripped", _tripped(trip)),
        ("to do", quantity.remedy),
    ]


def _tripped(trip: TrippedInterlock | None) -> str:
    if trip is None:
        return "no"
    how = "n resets it" if trip.reset == "hand" else "it resets itself"
    return f"yes: {trip.reason}; {how}"
