"""A D/A converter with an output watchdog, on Modbus/TCP and Modbus RTU at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fitctl.config import DacMock, ModbusDacDevice
from fitctl.drivers.modbus_dac.protocol import CHANNELS, counts_max, decode_counts, encode_volts
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.modbus.pdu import DataModel, DeviceFailure
from fitctl.mocks.modbus.rtu import ModbusRtuServer
from fitctl.mocks.modbus.tcp import ModbusTcpServer
from fitctl.mocks.pty import Endpoints
from fitctl.mocks.timers import Watchdog

FAULTS = WIRE_FAULTS | {
    "watchdog_trip": FaultKind("outputs are at their safe value, and every request is refused"),
}
_IDENTITY = (b"fitctl", b"mock D/A", b"1.0")


class ModbusDacMock:
    """Three output registers on 127.0.0.1 and on a pty, and a watchdog that makes the outputs safe.

    Functions 03, 06, 16, 23 and 2B/0E (identification: basic objects).

    The watchdog runs out when no write came for its time: outputs go to their safe value. Makers differ
    in what comes next: the next write is obeyed (Turck), or every request is refused with exception 04
    until the watchdog is reset (WAGO 750). `settings.watchdog_latches` says which.

    Known limitations
    -----------------
    - An output settles at once: no slew rate, no converter delay, no noise, no gain error.
    - Any number of TCP clients may connect; real stations allow a few.
    - A pty tells the baud rate that a client has set, but neither its parity nor its stop bits, and it
      has no gaps between bytes, so a frame is never broken by a gap of 1.5 characters.
    - A latched watchdog is reset by cycling the power alone; real stations have a register for it.

    Invented constants
    ------------------
    Outputs power up at `safe_v` and are at 0 V without power; the watchdog starts with the first write,
    and where it does not latch, the first write after it tripped starts it again; a count beyond the
    resolution is refused with exception 04, since the standard keeps 03 for wrong requests; maker, model
    and version of the identification.

    Parameters
    ----------
    dac : ModbusDacDevice
        Unit, registers, resolution, full scale and baud rate; where it says the device is, is not used.
    settings : DacMock
        The watchdog, and what requests to other units get.
    on_outputs : callable
        Gets the three voltages, once at start and whenever one changes, before the write is
        answered.
    port : int
        TCP port to listen on; 0 for any free port.

    Attributes
    ----------
    faults : Faults
    watchdog_trips : int
        How often the watchdog has put the outputs to their safe value.
    """

    def __init__(
        self,
        dac: ModbusDacDevice,
        settings: DacMock,
        on_outputs: Callable[[Sequence[float]], None],
        *,
        port: int,
    ) -> None:
        self.faults = Faults(FAULTS)
        self.watchdog_trips = 0
        self._dac = dac
        self._settings = settings
        self._on_outputs = on_outputs
        self._safe = encode_volts([settings.safe_v] * CHANNELS, dac.full_scale_v, dac.bits)
        self._counts = list(self._safe)
        self._latched = False
        self._watchdog = Watchdog(self._trip, settings.watchdog_s)
        first = dac.first_register
        model = DataModel(range(first, first + CHANNELS), self._read, self._write, _IDENTITY)
        self._port = port
        self._tcp = ModbusTcpServer(
            model, self.faults, unit=dac.device_id, unknown_unit=settings.unknown_unit
        )
        self._rtu = ModbusRtuServer(model, self.faults, unit=dac.device_id, baud_rate=dac.baud_rate)
        self.faults.on_change(self._fault_changed)

    @property
    def outputs_v(self) -> list[float]:
        """What the three channels give now."""
        if self.faults.value("reboot") is not None:
            return [0.0] * CHANNELS
        full_scale_v = self._settings.true_full_scale_v or self._dac.full_scale_v
        swapped = self._settings.bytes_swapped
        counts = [_swapped(count) for count in self._counts] if swapped else self._counts
        return decode_counts(counts, full_scale_v, self._dac.bits)

    async def start(self) -> Endpoints:
        """Listen, and give the plant its first outputs.

        Raises
        ------
        OSError
            If the port is taken.
        """
        endpoints = Endpoints(await self._tcp.start(self._port), await self._rtu.start())
        self._on_outputs(self.outputs_v)
        return endpoints

    async def stop(self) -> None:
        """Close both ends; safe to call twice."""
        self.faults.close()
        self._watchdog.stop()
        await self._tcp.stop()
        await self._rtu.stop()

    def _read(self, address: int, count: int) -> list[int]:
        self._refuse_if_tripped()
        channel = address - self._dac.first_register
        return self._counts[channel : channel + count]

    def _write(self, address: int, values: Sequence[int]) -> None:
        self._refuse_if_tripped()
        if max(values) > counts_max(self._dac.bits):
            raise DeviceFailure
        channel = address - self._dac.first_register
        counts = list(self._counts)
        counts[channel : channel + len(values)] = values
        self._set(counts)
        self._watchdog.feed()

    def _refuse_if_tripped(self) -> None:
        if self._latched or self.faults.value("watchdog_trip") is not None:
            raise DeviceFailure

    def _set(self, counts: list[int]) -> None:
        changed = counts != self._counts
        self._counts = counts
        if changed:
            self._on_outputs(self.outputs_v)

    def _trip(self) -> None:
        self._watchdog.stop()
        self.watchdog_trips += 1
        self._latched = self._settings.watchdog_latches
        self._set(list(self._safe))

    def _fault_changed(self, kind: str) -> None:
        if kind == "watchdog_trip" and self.faults.value(kind) is not None:
            self._trip()
        if kind == "reboot":  # both its ends: power gone, power back
            self._watchdog.stop()
            self._latched = False
            self._counts = list(self._safe)
            self._on_outputs(self.outputs_v)


def _swapped(count: int) -> int:
    """A register's two bytes the other way round."""
    return (count & 0xFF) << 8 | count >> 8
