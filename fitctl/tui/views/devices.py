"""Devices: every reading beside its limits, links, faults, and what can be done."""

from __future__ import annotations

from typing import ClassVar

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.messages.commands import Reset
from fitctl.tui.commands import keys_of
from fitctl.tui.dialogs import Reader
from fitctl.tui.inks import DIM, INK
from fitctl.tui.views.view import View
from fitctl.tui.widgets.readings import Detail, DeviceList, Readings, device_lines, reading_lines


class DevicesView(View):
    """Devices above, readings below; where there is room, all about the chosen row under them."""

    view_name = "devices"
    BINDINGS: ClassVar[list[BindingType]] = [
        key.binding() for key in keys_of("devices") if key.action
    ]

    def parts(self) -> ComposeResult:
        """Two lists, and the chosen row."""
        devices = DeviceList(self.state, "Devices")
        readings = Readings(self.state, "Readings, nearest to a limit first")
        yield devices
        yield readings
        yield Detail(self.state, "Chosen", devices, readings)

    def action_more(self) -> None:
        """All about the chosen row."""
        devices, readings = self.query_one(DeviceList), self.query_one(Readings)
        loop, row = self.state.loop, readings.now()
        device = devices.now()
        if devices.takes_keys and device is not None:
            self.app.push_screen(Reader(device.device, _table(device_lines(devices, device))))
        elif readings.takes_keys and loop is not None and row is not None:
            self.app.push_screen(Reader(row.name, _table(reading_lines(loop, row))))

    def action_reset(self) -> None:
        """Let the chosen interlock go."""
        row = self.query_one(Readings).now()
        if row is None or not self.query_one(Readings).takes_keys:
            self.notify("choose an interlock first: tab, then up and down", timeout=3)
        else:
            self.console.send(Reset(name=row.name))


def _table(lines: list[tuple[str, str]]) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, content in lines:
        table.add_row(Text(name, DIM), Text(content, INK))
    return table
