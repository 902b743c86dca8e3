"""The Devices screen's two lists: devices with their links, and every reading beside its limits."""

from __future__ import annotations

import math

from rich.segment import Segment

from fitctl.config import QUANTITIES
from fitctl.logging.records import DeviceHealth
from fitctl.messages.telemetry import TrippedInterlock, Watched
from fitctl.tui.look import (
    DEVICES,
    DIM,
    GREEN,
    INK,
    ORANGE,
    RED,
    SKY,
    Line,
    bar,
    number,
    shorten,
    text,
    wall,
    width,
)
from fitctl.tui.state import LoopView
from fitctl.tui.widgets.choice import Choice

NAME_COLUMNS = 21
# What a device's link is measured by: a quantity, its unit as people write it, and what it is in it.
LINKS = {
    "camera": ("frame_late_s", "frame late", 1e3, "ms"),
    "siderostat": ("amplifier_round_trip_periods", "round trip", 100.0, "% of period"),
    "D/A": ("dac_round_trip_s", "round trip", 1e3, "ms"),
}
UNITS = {"s": "s", "bytes": "GB", "rad": "rad", "v": "V", "fraction": "%", "periods": "periods"}
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
    """A device a row: state, name, link, what it says of itself, where it is."""

    def rows(self, columns: int) -> list[Line]:
        """All devices of the rig."""
        return [self._row(device, columns) for device in self.devices()]

    def devices(self) -> list[DeviceHealth]:
        """As telemetry has them."""
        return self.state.newest.devices if self.state.newest else []

    def _row(self, device: DeviceHealth, columns: int) -> Line:
        look = DEVICES[device.state]
        line = [
            text(f"{look.symbol} ", look.colour, bold=True),
            text(device.device.ljust(17), INK, bold=True),
            text(f"{device.state:<7}", look.colour),
            text(f"{self.link_of(device):<29}", INK),
        ]
        report = device.detail if device.state == "fault" else f"{device.identity}  {device.detail}"
        rest = columns - width(line)
        return [*line, text(shorten(f"{report}  {device.endpoint}", rest), DIM)]

    def link_of(self, device: DeviceHealth) -> str:
        """How quick its link is, in words; empty where nothing says so."""
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
        """Of the loop on the screen."""
        return self.state.loop.state.watched if self.state.loop else []

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
        return [_reading(row, columns, tripped=row.name in tripped) for row in loop.state.watched]

    def now(self) -> Watched | None:
        """The chosen row."""
        rows = self.watched()
        return rows[self.chosen] if self.chosen < len(rows) else None


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
    return f"≤ {high}" if high else f"≥ {low}" if low else "only not stale"


def _gauge(row: Watched, columns: int, colour: str) -> list[Segment]:
    """How much of what is allowed is used, where there is an upper limit."""
    if row.high is None or row.high <= 0 or math.isnan(row.value):
        return []
    return bar(abs(row.value) / row.high, min(columns, 30), colour)


def device_lines(devices: DeviceList, device: DeviceHealth) -> list[tuple[str, str]]:
    """All about a device: names and what there is to say."""
    return [
        ("state", device.state),
        ("endpoint", device.endpoint),
        ("identity", device.identity or "not told yet"),
        ("says", device.detail),
        ("link", devices.link_of(device) or "no reading"),
        ("since", wall(devices.state.wall_s(device.time_s)) + " (last told)"),
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
