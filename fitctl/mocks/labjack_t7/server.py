"""A LabJack T7 on Modbus/TCP: analog inputs with their settings, and what it says of itself."""

from __future__ import annotations

import math
import random
import struct
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from fitctl.config import AIN_RANGES_V, LabJackMock, LabJackT7Device
from fitctl.drivers.labjack_t7 import protocol
from fitctl.drivers.labjack_t7.protocol import DIODES, INPUTS, Register
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.modbus.pdu import DataModel, Refusal
from fitctl.mocks.modbus.tcp import ModbusTcpServer

_PARTS = tuple(f"AIN{number}" for number in range(DIODES))
_PAIRS = {"az": (0, 1), "el": (2, 3)}  # of the photodiodes az+, az-, el+, el-
FAULTS = WIRE_FAULTS | {
    "exception": FaultKind("every request is refused with this exception", "exception code", 4.0),
    "not_a_number": FaultKind("an input reads NaN", parts=_PARTS),
    "wrong_value": FaultKind(
        "an input reads this value, whatever its voltage", "V", -9999.0, _PARTS
    ),
    "stuck_input": FaultKind("an input keeps the reading that it has", parts=_PARTS),
    "offset_drift": FaultKind("an input's offset grows", "V/s", 0.01, _PARTS),
    "noise": FaultKind("an input has this much additional noise, RMS", "V", 0.05, _PARTS),
    "unplugged": FaultKind("nothing is connected to an input: it reads about 0 V", parts=_PARTS),
    "swapped": FaultKind("the two photodiodes of an axis are exchanged", parts=tuple(_PAIRS)),
    "range_changed": FaultKind("another client sets this range of all inputs", "V", 1.0),
    "laser_dim": FaultKind("only this part of the laser's light remains", "of its light", 0.0),
}
_READING = {protocol.READ_HOLDING_REGISTERS, protocol.READ_INPUT_REGISTERS}
_ADDRESS_AND_COUNT = struct.Struct(">HH")
_CLIENTS_MAX = 2
_FULL_RANGE_V = AIN_RANGES_V[0]


class _Setting(NamedTuple):
    """One setting of each input, and the register that has it for all.

    Attributes
    ----------
    of_all, of_first : Register
        The register for all inputs, and the one of AIN0, which those of the other inputs follow.
    default : float
    if_not_equal : float
        What `of_all` reads where inputs differ.
    error : int
        LAST_ERR_DETAIL where a value is refused.
    """

    of_all: Register
    of_first: Register
    default: float
    if_not_equal: float
    error: int


_RANGE = _Setting(
    protocol.AIN_ALL_RANGE,
    Register(40000, "FLOAT32"),
    0.0,
    protocol.NOT_ALL_EQUAL,
    protocol.RANGE_INVALID,
)
_NEGATIVE_CH = _Setting(
    protocol.AIN_ALL_NEGATIVE_CH,
    Register(41000, "UINT16"),
    protocol.SINGLE_ENDED,
    protocol.NOT_ALL_EQUAL_UINT16,
    protocol.NEGATIVE_INVALID,
)
_RESOLUTION = _Setting(
    protocol.AIN_ALL_RESOLUTION_INDEX,
    Register(41500, "UINT16"),
    0.0,
    protocol.NOT_ALL_EQUAL_UINT16,
    protocol.RESOLUTION_INVALID,
)
_SETTLING = _Setting(
    protocol.AIN_ALL_SETTLING_US,
    Register(42000, "FLOAT32"),
    0.0,
    protocol.NOT_ALL_EQUAL,
    protocol.SETTLING_INVALID,
)
_SETTINGS = (_RANGE, _NEGATIVE_CH, _RESOLUTION, _SETTLING)


class _Cell(NamedTuple):
    """What is behind a register; without `write` it can only be read."""

    register: Register
    read: Callable[[], float]
    check: Callable[[float], bool] = lambda _value: False
    error: int = 0
    write: Callable[[float], None] | None = None


class LabJackT7Mock:
    """The T7's analog inputs and their settings on 127.0.0.1.

    Functions 03, 04, 06 and 16 on one map of addresses: AIN0 to AIN13, their range, negative channel,
    resolution index and settling time, each and all (AIN_ALL_...), PRODUCT_ID, HARDWARE_VERSION,
    FIRMWARE_VERSION, HARDWARE_INSTALLED, SERIAL_NUMBER and LAST_ERR_DETAIL. As LabJack's list of errors says,
    an address that the device does not have is exception 02, and so is writing what can only be read; a value
    that a register cannot have is 03. Two clients at once.

    A request takes `settings.overhead_s` and, for each input that it reads, a conversion's time at the input's
    resolution index and its settling time; requests wait for each other, whoever sent them. Inputs are
    sampled in the middle of that time. Noise is that of the resolution index.

    Known limitations
    -----------------
    - All inputs of a request are sampled at one instant; the device converts one after the other.
    - No other register, no function 76 (LabJack's own "feedback"), no stream, no UDP, no USB. Registers that
      read words one by one (TEST) and strings are missing, as are LAST_MB_ERR and its kin, and AIN14 on.
    - A request reads at most 125 registers, as in the standard; the device's documents allow 127.
    - A converter has neither steps nor gain error nor crosstalk, and settles whatever the settling time is.
    - The settings at power-up cannot be changed (IO_CONFIG_...).

    Invented constants
    ------------------
    Every unit is the device itself. A third client is cut off at once. Half of a 32-bit value is exception 03.
    A write of several registers is carried out whole or not at all. Noise and the ends of a range are in
    proportion to the range: the data sheet has them for 10 V, -10.5 to 10.1 V. Range and settling time read
    what was written, 0 at power-up. An input to which nothing is connected reads 0 V. Hardware version. A
    client that is more than 16 KiB of requests ahead is cut off.

    Parameters
    ----------
    device : LabJackT7Device
        Which input each photodiode is wired to; where it says the device is, and its settings, are not used.
    settings : LabJackMock
    volts : callable
        Gets a recent host time; returns what the photodiodes az+, az-, el+ and el- gave then, V.
    set_laser : callable
        Gets the laser's power over its nominal power, when the fault ``laser_dim`` begins or ends.
    seed : int
        Of the converter's noise.

    Attributes
    ----------
    faults : Faults
    """

    def __init__(
        self,
        device: LabJackT7Device,
        settings: LabJackMock,
        volts: Callable[[float], Sequence[float]],
        *,
        set_laser: Callable[[float], None] = lambda _power: None,
        seed: int = 0,
    ) -> None:
        self.faults = Faults(FAULTS)
        self._wiring = device.inputs
        self._settings = settings
        self._volts = volts
        self._set_laser = set_laser
        self._random = random.Random(seed)  # noqa: S311 - not for secrets
        self._last_error = 0
        self._held_v: dict[str, float] = {}
        self._drifts_from_s: dict[str, float] = {}
        self._scan_v: list[float] = []
        self._values = {setting: [setting.default] * INPUTS for setting in _SETTINGS}
        self._cells = {cell.register.address: cell for cell in self._every_cell()}
        addresses = {
            cell.register.address + place
            for cell in self._cells.values()
            for place in range(cell.register.count)
        }
        model = DataModel(addresses, self._read, self._write, (), protocol.FUNCTIONS)
        self._server = ModbusTcpServer(
            model,
            self.faults,
            unit=1,
            unknown_unit="serve",
            clients_max=_CLIENTS_MAX,
            service_s=self._service_s,
        )
        self.faults.on_change(self._fault_changed)

    async def start(self) -> int:
        """Listen; returns the port.

        Raises
        ------
        OSError
            If the port is taken.
        """
        return await self._server.start(self._settings.modbus_port)

    async def stop(self) -> None:
        """Disconnect every client and stop listening; safe to call twice."""
        self.faults.close()
        await self._server.stop()

    # ------------------------------------------------------------ registers
    def _every_cell(self) -> list[_Cell]:
        """What the device has, one entry a value."""
        settings = self._settings
        constants = {
            protocol.PRODUCT_ID: protocol.T7,
            protocol.HARDWARE_VERSION: 1.3,
            protocol.FIRMWARE_VERSION: settings.firmware,
            protocol.HARDWARE_INSTALLED: protocol.HIGH_RESOLUTION if settings.pro else 0,
            protocol.SERIAL_NUMBER: settings.serial_number,
        }
        cells = [_Cell(register, partial(float, value)) for register, value in constants.items()]
        cells.append(_Cell(protocol.LAST_ERR_DETAIL, lambda: self._last_error))
        cells += [
            _Cell(protocol.ain(number), partial(self._reading_v, number))
            for number in range(INPUTS)
        ]
        return cells + [cell for setting in _SETTINGS for cell in self._setting_cells(setting)]

    def _setting_cells(self, setting: _Setting) -> list[_Cell]:
        values = self._values[setting]
        first, count = setting.of_first, setting.of_first.count
        cells = [
            _Cell(
                Register(first.address + count * number, first.kind),
                partial(values.__getitem__, number),
                partial(self._is_allowed, setting, number),
                setting.error,
                partial(values.__setitem__, number),
            )
            for number in range(INPUTS)
        ]
        every = _Cell(
            setting.of_all,
            partial(self._common_value, setting),
            partial(self._is_allowed, setting, None),
            setting.error,
            partial(self._set_all, setting),
        )
        return [*cells, every]

    def _is_allowed(self, setting: _Setting, number: int | None, value: float) -> bool:
        """Whether an input, or all of them, can have this value of a setting."""
        if setting is _RANGE:
            return value in {0.0, *map(protocol.as_float32, AIN_RANGES_V)}
        if setting is _RESOLUTION:
            most = max(protocol.CONVERTER) if self._settings.pro else protocol.FIRST_PRO_INDEX - 1
            return value <= most
        if setting is _SETTLING:
            return 0.0 <= value <= protocol.SETTLING_MAX_US  # false where it is NaN
        if value == protocol.SINGLE_ENDED:
            return True
        return value == 1 if number is None else number % 2 == 0 and value == number + 1

    def _common_value(self, setting: _Setting) -> float:
        values = self._values[setting]
        if values.count(values[0]) == INPUTS:
            return values[0]
        if setting is _NEGATIVE_CH and values == _differential():
            return 1
        return setting.if_not_equal

    def _set_all(self, setting: _Setting, value: float) -> None:
        is_differential = setting is _NEGATIVE_CH and value == 1
        self._values[setting][:] = _differential() if is_differential else [value] * INPUTS

    def _read(self, address: int, count: int) -> list[int]:
        self._refuse_on_demand()
        if address < protocol.AIN_REGISTERS * INPUTS:
            self._scan_v = self._sample(address, count)
        registers: list[int] = []
        while len(registers) < count:
            cell = self._cells.get(address + len(registers))
            if cell is None or len(registers) + cell.register.count > count:
                raise self._refusal(protocol.MUST_BE_EVEN)
            registers += protocol.encode(cell.register, cell.read())
        return registers

    def _write(self, address: int, registers: Sequence[int]) -> None:
        self._refuse_on_demand()
        changes: list[Callable[[], None]] = []
        done = 0
        while done < len(registers):
            cell = self._cells.get(address + done)
            if cell is None or done + cell.register.count > len(registers):
                raise self._refusal(protocol.MUST_BE_EVEN)
            if cell.write is None:
                raise Refusal(protocol.ILLEGAL_ADDRESS)
            words = registers[done : done + cell.register.count]
            value = protocol.decode(cell.register, words)
            if not cell.check(value):
                raise self._refusal(cell.error)
            changes.append(partial(cell.write, value))
            done += cell.register.count
        for change in changes:
            change()

    def _refusal(self, detail: int) -> Refusal:
        self._last_error = detail
        return Refusal(protocol.ILLEGAL_VALUE)

    def _refuse_on_demand(self) -> None:
        if self.faults.strikes("exception"):
            raise Refusal(int(self.faults.value("exception") or 0) & 0xFF)

    # ------------------------------------------------------------ analog inputs
    def _service_s(self, request: bytes) -> float:
        """How long a request keeps the device busy."""
        body = request[1:]
        scan_s = 0.0
        if request[0] in _READING and len(body) == _ADDRESS_AND_COUNT.size:
            scan_s = self._scan_s(*_ADDRESS_AND_COUNT.unpack(body))
        return self._settings.overhead_s + scan_s

    def _scan_s(self, address: int, count: int) -> float:
        """How long the conversions of a reading of registers take."""
        first = address // protocol.AIN_REGISTERS
        end = -(-(address + count) // protocol.AIN_REGISTERS)
        return sum(
            self._converter(number).sample_s + 1e-6 * self._values[_SETTLING][number]
            for number in range(first, min(end, INPUTS))
        )

    def _converter(self, number: int) -> protocol.Converter:
        index = int(self._values[_RESOLUTION][number])
        return protocol.converter(index, pro=self._settings.pro)

    def _sample(self, address: int, count: int) -> list[float]:
        """The voltages of all inputs amid the request that is answered now."""
        took_s = self._settings.overhead_s + self._scan_s(address, count)
        diodes = list(self._volts(time.monotonic() - took_s / 2))
        for axis, (plus, minus) in _PAIRS.items():
            if self.faults.value("swapped", axis) is not None:
                diodes[plus], diodes[minus] = diodes[minus], diodes[plus]
        inputs = [0.0] * INPUTS
        for diode_v, number in zip(diodes, self._wiring, strict=True):
            if self.faults.value("unplugged", _PARTS[number]) is None:
                inputs[number] = diode_v
        return inputs

    def _reading_v(self, number: int) -> float:
        """What an input reads, faults and all."""
        negative = int(self._values[_NEGATIVE_CH][number])
        volts = self._scan_v[number]
        if negative != protocol.SINGLE_ENDED:
            volts -= self._scan_v[negative]
        range_v = self._values[_RANGE][number] or _FULL_RANGE_V
        noise_v = self._converter(number).noise_v * range_v / _FULL_RANGE_V
        part = _PARTS[number] if number < DIODES else ""
        if part:
            volts += self._drift_v(part)
            noise_v = math.hypot(noise_v, self.faults.value("noise", part) or 0.0)
        volts += self._random.gauss(0.0, noise_v)
        low_v, high_v = protocol.LOW_OF_RANGE * range_v, protocol.HIGH_OF_RANGE * range_v
        volts = min(max(volts, low_v), high_v)
        return self._spoilt_v(part, volts) if part else volts

    def _drift_v(self, part: str) -> float:
        rate_v_s = self.faults.value("offset_drift", part)
        if rate_v_s is None:
            return 0.0
        return rate_v_s * (time.monotonic() - self._drifts_from_s[part])

    def _spoilt_v(self, part: str, volts: float) -> float:
        if self.faults.strikes("not_a_number", part):
            return math.nan
        if self.faults.strikes("wrong_value", part):
            return self.faults.value("wrong_value", part) or 0.0
        if self.faults.value("stuck_input", part) is not None:
            return self._held_v.setdefault(part, volts)
        return volts

    # ------------------------------------------------------------ faults
    def _fault_changed(self, kind: str) -> None:
        for part in _PARTS:
            if self.faults.value("offset_drift", part) is None:
                self._drifts_from_s.pop(part, None)
            else:
                self._drifts_from_s.setdefault(part, time.monotonic())
            if self.faults.value("stuck_input", part) is None:
                self._held_v.pop(part, None)
        if kind == "laser_dim":
            power = self.faults.value(kind)
            self._set_laser(1.0 if power is None else power)
        if kind == "reboot":
            self._last_error = 0
            for setting, values in self._values.items():
                values[:] = [setting.default] * INPUTS
        range_v = self.faults.value("range_changed")
        if kind == "range_changed" and range_v is not None:
            self._set_all(_RANGE, protocol.as_float32(range_v))


def _differential() -> list[float]:
    """The negative channels where every even input is measured against the one after it."""
    return [number + 1 if number % 2 == 0 else protocol.SINGLE_ENDED for number in range(INPUTS)]
