"""Whether the parts are well: devices, the loop's timing, the recorder."""

from __future__ import annotations

import math
import re
import textwrap
from pathlib import PurePath
from typing import ClassVar

import msgspec

from fitctl.logging.records import DeviceHealth, LoopTiming
from fitctl.messages.telemetry import Telemetry
from fitctl.tui.inks import DIM, GREEN, INK, ORANGE, PAPER, RED
from fitctl.tui.look import DEVICES, Line, number, shorten, spread, text, width
from fitctl.tui.widgets.panel import Panel

TABLE_FROM_ROWS = 7
DETAIL_INDENT = 4
DETAIL_FROM_COLUMNS = 8  # less says nothing
STATES = ("fault", "closed", "ok")  # in the order in which devices are shown
_PLACE = re.compile(r"^[^:;]* at \S+: ")  # which device and where, of which the row has the name


class Devices(Panel):
    """One device a row.

    Where rows are short, ill devices keep rows of their own; the well ones of the loop on the screen
    share the rest.
    """

    every: ClassVar[int] = 5

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Ill devices before healthy ones."""
        devices = self.state.newest.devices if self.state.newest else []
        if len(self.state.loops) == 1:
            devices = [_without_loop(device, self.state.shown) for device in devices]
        devices = sorted(devices, key=lambda device: STATES.index(device.state))
        others = tuple(f"{name} " for name in self.state.loops if name != self.state.shown)
        if len(devices) > rows:  # then those of other loops only while they are ill
            devices = [
                _without_loop(device, self.state.shown) if device.state == "ok" else device
                for device in devices
                if device.state != "ok" or not device.device.startswith(others)
            ]
        if len(devices) <= rows:
            names = {  # a long name of a device at fault leaves the well ones room for what they report
                ill: max((len(d.device) for d in devices if (d.state != "ok") is ill), default=0)
                for ill in (False, True)
            }
            spare, faults = rows - len(devices), sum(d.state == "fault" for d in devices)
            lines: list[Line] = []
            for number, device in enumerate(devices):
                name_columns = names[device.state != "ok"]
                own = _device(device, name_columns, columns, 1 + spare // max(1, faults - number))
                spare -= len(own) - 1
                lines += own
            return lines
        ill = [device for device in devices if device.state != "ok"]
        well = [device for device in devices if device.state == "ok"]
        lines = [_device(device, len(device.device), columns, 1)[0] for device in ill]
        return lines + _packed(well, columns)


def _without_loop(device: DeviceHealth, loop: str) -> DeviceHealth:
    """Name a device without its loop, where there is no doubt which loop is meant."""
    return msgspec.structs.replace(device, device=device.device.removeprefix(f"{loop} "))


def _device(device: DeviceHealth, name_columns: int, columns: int, rows: int) -> list[Line]:
    look = DEVICES[device.state]
    line = [
        text(f"{look.symbol} ", look.colour, bold=True),
        text(device.device.ljust(name_columns), INK),
    ]
    ill = device.state != "ok"
    if ill:
        line.append(text(f" {device.state}", look.colour, bold=True))
    detail = _PLACE.sub("", device.detail) or device.identity or device.endpoint
    if device.state == "fault" and detail and rows > 1:
        pieces = textwrap.wrap(
            detail, max(10, columns - DETAIL_INDENT), max_lines=rows - 1, placeholder="…"
        )
        return [line, *([text(" " * DETAIL_INDENT + piece, DIM)] for piece in pieces)]
    room = columns - width(line) - 1
    return [
        [*line, text(" " + shorten(detail, room), DIM)] if room >= DETAIL_FROM_COLUMNS else line
    ]


def _packed(devices: list[DeviceHealth], columns: int) -> list[Line]:
    lines: list[Line] = [[]]
    for device in devices:
        look = DEVICES[device.state]
        piece = [
            text(look.symbol, look.colour, bold=True),
            text(f" {device.device}  ", INK),
        ]
        if lines[-1] and width(lines[-1]) + width(piece) - 2 > columns:
            lines.append([])
        lines[-1] += piece
    return lines


class Timing(Panel):
    """Median and worst times, what was late or lost, the scheduling reached, and the log file."""

    every: ClassVar[int] = 5

    def draw(self, columns: int, rows: int) -> list[Line]:
        """A table where there is room for one, else two dense lines; the log in the last line."""
        newest, loop = self.state.newest, self.state.loop
        if newest is None or loop is None:
            return []
        recorder = _recorder(newest, columns)
        if loop.timing is None:
            return [[text("no timing yet", DIM)], recorder]
        unsent = sum(newest.losses.unsent.values())
        if rows < TABLE_FROM_ROWS:
            return [*_dense(loop.timing, unsent, newest.scheduling, columns), recorder]
        table = _table(loop.timing, unsent, columns)
        notes = textwrap.wrap(newest.scheduling, columns)[: rows - len(table) - 1]
        return [*table, *([text(note, DIM)] for note in notes), recorder]


def _recorder(newest: Telemetry, columns: int) -> Line:
    lost = newest.records_lost
    if lost:
        return [text(f" ✗ {lost:,} RECORDS LOST ".replace(",", " "), PAPER, on=RED, bold=True)]
    recorder = newest.recorder
    if newest.recorder_awaited:
        return [text("○ the recorder is starting", DIM)]
    if recorder is None:
        return [text("○", ORANGE, bold=True), text(" not recording", ORANGE)]
    size = f"{recorder.bytes_written / 1e6:.1f} MB"
    count = f"{recorder.records:,} rec, lost 0".replace(",", " ") if columns >= 60 else size
    name = shorten(PurePath(recorder.path).name, columns - len(count) - 4)
    return spread([text("● ", GREEN), text(name, INK)], [text(count, DIM)], columns)


def _dense(timing: LoopTiming, unsent: int, scheduling: str, columns: int) -> list[Line]:
    pairs = (
        ("tick", timing.compute_median_s, timing.compute_worst_s),
        ("age", timing.frame_age_median_s, timing.frame_age_worst_s),
        ("servo", timing.servo_late_median_s, timing.servo_late_worst_s),
    )
    times: Line = []
    for name, median_s, worst_s in pairs:
        pair = [text(f"{name} ", DIM), text(f"{_short_ms(median_s)}/{_short_ms(worst_s)} ", INK)]
        times += pair if width(times) + width(pair) + 2 <= columns else []
    counts = _counts(timing, unsent, columns)
    room = columns - width(counts) - 1
    return [
        [*times, text("ms", DIM)],
        spread(counts, [text(shorten(scheduling, room), DIM)], columns),
    ]


def _table(timing: LoopTiming, unsent: int, columns: int) -> list[Line]:
    rows = (
        ("compute", timing.compute_median_s, timing.compute_worst_s),
        ("frame age", timing.frame_age_median_s, timing.frame_age_worst_s),
        ("servo late", timing.servo_late_median_s, timing.servo_late_worst_s),
    )
    return [
        [text(f"{'ms':<12}{'median':>8}{'worst':>8}", DIM)],
        *(
            [text(f"{name:<12}", DIM), text(f"{_ms(median_s):>8}{_ms(worst_s):>8}", INK)]
            for name, median_s, worst_s in rows
        ),
        _counts(timing, unsent, columns),
    ]


def _counts(timing: LoopTiming, unsent: int, columns: int) -> Line:
    """What went wrong: in the last second; frames and what no console was sent since the start.

    A line too short for all counts leaves out those that are 0.
    """
    counts = [
        ("late", timing.late_ticks),
        ("lost", timing.frames_lost),
        ("miss", timing.servo_missed),
        ("stall", timing.stalls),
    ]
    counts += [("unsent", unsent)] if unsent else []  # there is hardly room for it
    pieces = [
        [text(f"{name} ", DIM), text(f"{count}! ", ORANGE, bold=True) if count else text("0 ", INK)]
        for name, count in counts
    ]
    line = [part for piece in pieces for part in piece]
    if width(line) <= columns:
        return line
    return [
        part for (_, count), piece in zip(counts, pieces, strict=True) if count for part in piece
    ]


def _ms(seconds: float) -> str:
    milliseconds = 1e3 * seconds
    return number(milliseconds, ".2f" if milliseconds < 10 else ".1f")


def _short_ms(seconds: float) -> str:
    milliseconds = 1e3 * seconds
    if math.isnan(milliseconds):
        return "–"
    if milliseconds < 0.995:
        return f"{milliseconds:.2f}".removeprefix("0")
    return f"{milliseconds:.1f}" if milliseconds < 9.95 else f"{milliseconds:.0f}"
