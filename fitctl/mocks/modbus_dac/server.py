"""A Modbus/TCP D/A converter with an output watchdog, on pymodbus's server and simulator."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from pymodbus import ModbusDeviceIdentification
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from fitctl.config import DacMock, ModbusDacDevice
from fitctl.drivers.modbus_dac.protocol import (
    CHANNELS,
    READ_HOLDING_REGISTERS,
    WRITE_MULTIPLE_REGISTERS,
    WRITE_SINGLE_REGISTER,
    counts_max,
    decode_counts,
    encode_volts,
)
from fitctl.mocks.faults import WIRE_FAULTS, Faults

FAULTS = dict(WIRE_FAULTS)
_FUNCTIONS = {READ_HOLDING_REGISTERS, WRITE_SINGLE_REGISTER, WRITE_MULTIPLE_REGISTERS}
_ADDRESSES = 65535


class ModbusDacMock:
    """Three output registers at 127.0.0.1, and a watchdog that puts them to a safe value.

    Functions 03, 06, 16 and 2B/0E (identification). Fails on command: `silent`, `refuse_with`,
    :meth:`drop_links`.

    Known limitations
    -----------------
    - An output settles at once: no slew rate, no converter delay, no noise, no gain error.
    - An address outside the registers is answered by exception 02 even where the function is not
      known either; the standard asks for exception 01 then.
    - pymodbus's server answers one request at a time: of two requests in one TCP segment, the
      second is not answered. Clients that wait for each answer do not notice.
    - Any number of clients may connect; real stations allow a few.

    Invented constants
    ------------------
    Outputs power up at `safe_v`; the watchdog starts with the first write, and the first write
    after it tripped starts it again; maker, model and version of the identification.

    Parameters
    ----------
    dac : ModbusDacDevice
        Device id, registers, resolution and full scale; its host and port are not used.
    settings : DacMock
        The watchdog.
    on_outputs : callable
        Gets the three voltages, once at start and whenever one changes, before the write is
        answered.
    port : int
        Where to listen; 0 for any free port.

    Attributes
    ----------
    watchdog_trips : int
        How often the watchdog has put the outputs to their safe value.
    silent : bool
        Neither act on requests nor answer them.
    refuse_with : int
        Answer every request with this exception code; 0 for none.
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
        self.silent = False
        self.refuse_with = 0
        self._dac = dac
        self._watchdog_s = settings.watchdog_s
        self._on_outputs = on_outputs
        self._port = port
        self._safe = encode_volts([settings.safe_v] * CHANNELS, dac.full_scale_v, dac.bits)
        self._counts = list(self._safe)
        self._watchdog: asyncio.TimerHandle | None = None
        self._server: ModbusTcpServer | None = None

    @property
    def outputs_v(self) -> list[float]:
        """What the three channels give now."""
        return decode_counts(self._counts, self._dac.full_scale_v, self._dac.bits)

    async def start(self) -> int:
        """Listen, and give the plant its first outputs.

        Returns
        -------
        int
            The port.

        Raises
        ------
        OSError
            If the port is taken.
        """
        server = ModbusTcpServer(
            self._devices(),
            address=("127.0.0.1", self._port),
            identity=ModbusDeviceIdentification(
                info_name={
                    "VendorName": "fitctl",
                    "ProductCode": "mock D/A",
                    "MajorMinorRevision": "1.0",
                }
            ),
            trace_packet=self._pass_packet,
        )
        try:
            await server.serve_forever(background=True)
        except RuntimeError as error:  # pymodbus hides the OSError
            msg = f"mock D/A: cannot listen on 127.0.0.1:{self._port}; is another testbed running?"
            raise OSError(msg) from error
        self._server = server
        self._on_outputs(self.outputs_v)
        listener = server.transport
        if not isinstance(listener, asyncio.Server):
            msg = f"pymodbus listens by {type(listener).__name__}, not by an asyncio server"
            raise TypeError(msg)
        port: int = listener.sockets[0].getsockname()[1]
        return port

    async def stop(self) -> None:
        """Disconnect everyone and stop listening; safe to call twice."""
        self._stop_watchdog()
        if self._server is not None:
            self.drop_links()
            await self._server.shutdown()
            self._server = None
            await asyncio.sleep(0)  # transports close their sockets on the loop's next turn

    def drop_links(self) -> None:
        """Close every connection, as a restart does; new ones are accepted."""
        if self._server is None:
            return
        for link in list(self._server.active_connections.values()):
            if isinstance(link.transport, asyncio.Transport):
                link.transport.abort()

    def _devices(self) -> list[SimDevice]:
        first = self._dac.first_register
        registers = SimData(first, values=list(self._counts), datatype=DataType.REGISTERS)
        devices = [SimDevice(self._dac.device_id, registers, action=self._serve)]
        if self._dac.device_id != 0:
            # Without a device for all other ids, pymodbus answers exception 04 in their name.
            everything = SimData(0, count=_ADDRESSES, values=0, datatype=DataType.REGISTERS)
            devices.append(SimDevice(0, everything, action=_serve_nobody))
        return devices

    async def _serve(
        self,
        function_code: int,
        first: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Answer pymodbus, which asks before every access; writes act here, at once."""
        if self.silent:
            return ExcCodes.DEVICE_FAILURE  # which _pass_packet swallows
        if self.refuse_with:
            return ExcCodes(self.refuse_with)
        if function_code not in _FUNCTIONS:
            return ExcCodes.ILLEGAL_FUNCTION
        if values is not None:
            if any(value > counts_max(self._dac.bits) for value in values):
                return ExcCodes.ILLEGAL_VALUE
            counts = list(self._counts)
            counts[address - first : address - first + count] = [int(value) for value in values]
            self._set(counts)
            self._restart_watchdog()
        registers[:CHANNELS] = self._counts
        return None

    def _set(self, counts: list[int]) -> None:
        changed = counts != self._counts
        self._counts = counts
        if changed:
            self._on_outputs(self.outputs_v)

    def _restart_watchdog(self) -> None:
        self._stop_watchdog()
        loop = asyncio.get_running_loop()
        self._watchdog = loop.call_later(self._watchdog_s, self._trip_watchdog)

    def _stop_watchdog(self) -> None:
        if self._watchdog is not None:
            self._watchdog.cancel()
            self._watchdog = None

    def _trip_watchdog(self) -> None:
        self._watchdog = None
        self.watchdog_trips += 1
        self._set(list(self._safe))

    def _pass_packet(self, sending: bool, packet: bytes) -> bytes:
        return b"" if sending and self.silent else packet


async def _serve_nobody(
    function_code: int,
    first: int,
    address: int,
    count: int,
    registers: list[int],
    values: list[int] | list[bool] | None,
) -> ExcCodes | None:
    return ExcCodes.GATEWAY_NO_RESPONSE
