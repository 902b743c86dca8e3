"""Two BAL 20-40-A amplifiers with motors and encoders, behind a Modbus/TCP I/O station."""

from __future__ import annotations

from collections.abc import Sequence

from fitctl.config import BalAnalogDevice, BalAnalogMock, Siderostat
from fitctl.drivers.bal_analog.protocol import (
    COUNTER_MODULUS,
    REGISTERS,
    counts_to_volts,
    lines,
    word_of,
)
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.modbus.pdu import DataModel
from fitctl.mocks.modbus.tcp import ModbusTcpServer
from fitctl.mocks.motors import AXES, AXIS_FAULTS, FaultyMotors, Motors
from fitctl.mocks.timers import Periodic, Watchdog

FAULTS = (
    WIRE_FAULTS
    | AXIS_FAULTS
    | {
        "command_offset": FaultKind(
            "an amplifier receives this much more than its command", "V", 0.05, AXES
        ),
    }
)
_HOLD_S = 0.005  # how often the outputs are applied to the motors again
_LINES = 2  # the register of both axes' lines
_IDENTITY = (b"fitctl", b"mock analogue amplifiers", b"1.0")


class BalAnalogMockStation:
    """The station on 127.0.0.1, and the amplifiers on its lines.

    Three output registers (velocity commands of az and el, enable lines) and three input registers
    (encoder counters of az and el, fault lines), all of them holding registers, at the addresses of the
    rig file; functions 03, 06, 16, 23 and 2B/0E.

    An amplifier follows its command while its enable line is up and it has no fault. A fault stays until
    its cause is gone and the enable line has been taken away. The station's output watchdog takes commands
    and enable lines away when nobody has written for `watchdog_s`; the next write is obeyed.

    Known limitations
    -----------------
    - Currents, commutation, tachometers and the amplifier's own adjustments are not there: its velocity
      loop is the plant's first-order lag.
    - Analogue outputs settle at once, without noise.
    - The mock's amplifiers have the velocity scale and line levels of the rig file.
    - Any number of clients; real stations allow a few.
    - The motors stop while this process stands still.

    Invented constants
    ------------------
    The register map, the watchdog, the identification, and that the enable line resets a fault.

    Parameters
    ----------
    siderostat : Siderostat[BalAnalogDevice]
        Encoder, registers, scales and levels.
    settings : BalAnalogMock
    motors : Motors
        What the amplifiers turn.

    Attributes
    ----------
    faults : Faults
    enabled : list of bool
        Which amplifiers follow their command.
    """

    def __init__(
        self, siderostat: Siderostat[BalAnalogDevice], settings: BalAnalogMock, motors: Motors
    ) -> None:
        self.faults = Faults(FAULTS)
        self.enabled = [False, False]
        self._device = device = siderostat.device
        self._settings = settings
        self._motors = FaultyMotors(motors, self.faults, siderostat.encoder_counts_per_rev)
        self._latched = [False, False]
        self._safe = [0, 0, word_of(False, False, device.enabled_level)]
        self._outputs = list(self._safe)
        self._watchdog = Watchdog(self._trip, settings.watchdog_s)
        self._hold = Periodic(self._hold_outputs)
        outputs, inputs = (
            range(first, first + REGISTERS)
            for first in (device.first_output_register, device.first_input_register)
        )
        self._first_output, self._first_input = outputs.start, inputs.start
        model = DataModel({*outputs, *inputs}, self._read, self._write, _IDENTITY)
        self._server = ModbusTcpServer(
            model, self.faults, unit=device.device_id, unknown_unit="refuse"
        )
        self.faults.on_change(self._fault_changed)

    async def start(self) -> int:
        """Listen; returns the port.

        Raises
        ------
        OSError
            If the port is taken.
        """
        port = await self._server.start(self._settings.modbus_port)
        self._hold.set_period(_HOLD_S)
        return port

    async def stop(self) -> None:
        """Take all power and disconnect everyone; safe to call twice."""
        self.faults.close()
        self._watchdog.stop()
        self._hold.set_period(0)
        self._outputs = list(self._safe)
        self._apply()
        await self._server.stop()

    # ------------------------------------------------------------ the station
    def _read(self, address: int, count: int) -> list[int]:
        registers = dict(enumerate(self._inputs(), self._first_input))
        registers |= dict(enumerate(self._outputs, self._first_output))
        return [registers[place] for place in range(address, address + count)]

    def _write(self, address: int, values: Sequence[int]) -> None:
        for place, value in enumerate(values, address - self._first_output):
            if 0 <= place < REGISTERS:  # what is written to an input is lost
                self._outputs[place] = value
        self._apply()
        self._watchdog.feed()

    def _inputs(self) -> list[int]:
        counters = [
            counts + start
            for counts, start in zip(
                self._motors.position_counts(), self._settings.counters_at_start, strict=True
            )
        ]
        self._update_latches()
        faults = word_of(self._latched[0], self._latched[1], self._device.fault_level)
        return [*(counter % COUNTER_MODULUS for counter in counters), faults]

    def _trip(self) -> None:
        self._outputs = list(self._safe)
        self._apply()

    # ------------------------------------------------------------ the amplifiers
    def _update_latches(self) -> None:
        """Latch the present faults, and clear the faults that were reset."""
        requested = lines(self._outputs[_LINES], self._device.enabled_level)
        for axis, part in enumerate(AXES):
            is_so = self.faults.value("amplifier_fault", part) is not None
            self._latched[axis] = is_so or (self._latched[axis] and requested[axis])

    def _apply(self) -> None:
        """The amplifiers do what their lines say."""
        self._update_latches()
        requested = lines(self._outputs[_LINES], self._device.enabled_level)
        for axis in range(len(AXES)):
            enabled = requested[axis] and not self._latched[axis]
            if enabled != self.enabled[axis]:
                self.enabled[axis] = enabled
                self._motors.set_enabled(axis, enabled)
        self._command_motors()

    def _hold_outputs(self) -> None:
        """An output stays as it is, but the motors take a command for a moment only."""
        if any(self.enabled):
            self._command_motors()

    def _command_motors(self) -> None:
        az, el = map(self._velocity_rad_s, range(len(AXES)))
        self._motors.command_velocity_rad_s(az, el)

    def _velocity_rad_s(self, axis: int) -> float:
        if not self.enabled[axis]:
            return 0.0
        device = self._device
        volts = counts_to_volts(self._outputs[axis], device.full_scale_v, device.full_scale_counts)
        volts += self.faults.value("command_offset", AXES[axis]) or 0.0
        scale = device.velocity_rad_s_per_v
        return volts * (scale.az, scale.el)[axis]

    def _fault_changed(self, kind: str) -> None:
        if kind == "reboot":
            self._watchdog.stop()
            self._outputs = list(self._safe)
        self._apply()
