"""The siderostat's two amplifiers as the paper's rig has them: +-10 V of velocity command, lines, encoders.

One transaction of function 23 a servo period writes both commands and the enable lines, and reads both
encoder counters and the fault lines. The counters have 16 bits: the driver counts on across their wrap,
and fails where it has not read them for longer than they are unambiguous.

The amplifiers themselves watch nobody: the station's output watchdog must take commands and enable lines
away when we are gone.
"""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import closing
from typing import NamedTuple

from pymodbus.pdu import ReadHoldingRegistersRequest
from pymodbus.pdu.register_message import ReadWriteMultipleRegistersRequest

from fitctl.config import BalAnalogDevice, Siderostat
from fitctl.drivers.amplifiers import AXES, DEVICE, LinkedAmplifiers
from fitctl.drivers.bal_analog.protocol import (
    COUNTER_MODULUS,
    EXCEPTIONS,
    REGISTERS,
    lines,
    signed,
    unwrap,
    velocity_to_counts,
    word_of,
)
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    AzEl,
    DeviceFault,
    DeviceIdentity,
    DeviceRefused,
    DeviceTimeout,
    ServoReading,
)
from fitctl.drivers.modbus import Answer, decode_exception, decode_registers
from fitctl.drivers.modbus_tcp import ModbusLink
from fitctl.drivers.plausibility import SPEED_MARGIN, MotionCheck, Pair
from fitctl.drivers.probe import Probe, round_trip_s

_STILL = (0.0, 0.0)
_FUNCTION = ReadWriteMultipleRegistersRequest.function_code
_MOST_OUTSTANDING = 100


class _Request(NamedTuple):
    """A transaction that is not answered yet, and how fast the motors may have turned until then."""

    number: int
    sent_s: float
    possible_counts_s: Pair


class BalAnalogAmplifiers(LinkedAmplifiers[ModbusLink, BalAnalogDevice]):
    """Both axes' amplifiers (:class:`fitctl.drivers.interface.ServoAmplifiers`).

    No line reports that an axis is enabled: it counts as enabled while its enable line is up and it
    reports no fault.

    Parameters
    ----------
    siderostat : Siderostat[BalAnalogDevice]
        Encoder, limits, servo rate and device settings of the rig.
    """

    def __init__(self, siderostat: Siderostat[BalAnalogDevice]) -> None:
        super().__init__(siderostat, siderostat.device.endpoint)
        self._period_s = 1.0 / siderostat.servo.rate_hz
        self._rad_per_count = 2 * math.pi / siderostat.encoder_counts_per_rev
        most_rad_s = SPEED_MARGIN * siderostat.velocity_limit_rad_s
        self._blind_s = COUNTER_MODULUS / 2 * self._rad_per_count / most_rad_s
        self._enable = False
        self._counts: tuple[int, int] | None = None
        self._counted_s = -math.inf
        self._answered_s = 0.0
        self._outstanding: deque[_Request] = deque(maxlen=_MOST_OUTSTANDING)
        self._motion = MotionCheck(siderostat.velocity_limit_rad_s / self._rad_per_count, 1.0)

    def open(self) -> DeviceIdentity:
        """Connect, disable both amplifiers and read their encoders.

        The counters' turns are kept from before, where they were read before; else the motors are taken
        to be less than half the counters' range from zero.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        self._enable = False
        self._outstanding.clear()
        self._motion.restart()
        self._counted_s = -math.inf
        with self._connected(_connect(self._device)) as link:
            identity = link.identify()
            self._settle()
        return identity

    def enable(self) -> None:
        """Power both axes at zero velocity.

        Raises
        ------
        DeviceFault
            An axis is in fault; then neither has power.
        """
        self._enable = True
        with self._disabled_on_failure():
            self._settle()
            reading = self._settle()  # the first answers were on their way when the lines changed
            if reading.fault:
                raise self._fault("both axes enabled", reading.fault)

    def disable(self) -> None:
        """Command zero velocity and take the enable lines away; a latched fault stays."""
        self._enable = False
        self._settle()

    def reset_fault(self) -> None:
        """Take the enable lines away, which resets an amplifier, and see that its fault goes.

        Raises
        ------
        DeviceFault
            A fault stays, because its cause does.
        """
        self._enable = False
        deadline_s = time.monotonic() + self._device.response_timeout_s
        while (reading := self._settle()).fault:
            if time.monotonic() > deadline_s:
                raise self._fault("no fault after a reset", reading.fault)

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: command both motors, read both encoders and fault lines.

        Returns
        -------
        ServoReading or None
            The newest that has come by the end of the period; its time is midway between request and
            answer. Counts that the motors cannot have reached are dropped.

        Raises
        ------
        DeviceUnreachable
            The link broke.
        DeviceTimeout
            No answer for `response_timeout_s`, or for so long that the counters may have wrapped unseen.
        DeviceRefused, DeviceProtocolError
            The station refuses, or what comes is no answer.
        DeviceFault
            A counter jumped.
        ValueError
            A velocity is not finite.
        """
        link = self._opened()
        sent_s = self._request(link, velocity_rad_s)
        newest: ServoReading | None = None
        while self._outstanding:
            answer = link.receive(sent_s + self._period_s)
            if answer is None:
                break
            newest = self._reading_of(answer) or newest
        self._check_jumped(self._motion, self._rad_per_count)
        if newest is None and sent_s - self._answered_s > self._device.response_timeout_s:
            raise self._silent()
        return newest

    # ------------------------------------------------------------ requests
    def _request(self, link: ModbusLink, velocity_rad_s: AzEl) -> float:
        """Send one transaction, velocities within the motors' limit; returns when."""
        wanted_rad_s = self._limited(velocity_rad_s)
        device = self._device
        scale = device.velocity_rad_s_per_v
        az, el = (
            velocity_to_counts(wanted, rad_s_per_v, device.full_scale_v, device.full_scale_counts)
            for wanted, rad_s_per_v in zip(wanted_rad_s, (scale.az, scale.el), strict=True)
        )
        enable = word_of(self._enable, self._enable, device.enabled_level)
        request = ReadWriteMultipleRegistersRequest(
            read_address=device.first_input_register,
            read_count=REGISTERS,
            write_address=device.first_output_register,
            write_registers=[az, el, enable],
        )
        sent_s = time.monotonic()
        if not self._outstanding:
            self._answered_s = sent_s
        az_rad_s, el_rad_s = wanted_rad_s
        possible_counts_s = self._motion.command(
            sent_s,
            (az_rad_s / self._rad_per_count, el_rad_s / self._rad_per_count)
            if self._enable
            else None,
        )
        self._outstanding.append(_Request(link.send(request), sent_s, possible_counts_s))
        return sent_s

    def _settle(self) -> ServoReading:
        """Command zero velocity and wait for the answer to that request; ask again if counts are dropped."""
        link = self._opened()
        deadline_s = self._request(link, _STILL) + self._device.response_timeout_s
        while (answer := link.receive(deadline_s)) is not None:
            is_newest = answer.transaction == self._outstanding[-1].number
            reading = self._reading_of(answer)
            if is_newest and reading is not None:
                return reading
            if is_newest:
                self._request(link, _STILL)
        raise self._silent()

    # ------------------------------------------------------------ answers
    def _reading_of(self, answer: Answer) -> ServoReading | None:
        """The reading in an answer; None if it answers no outstanding request, or is not plausible."""
        if all(request.number != answer.transaction for request in self._outstanding):
            return None
        while (request := self._outstanding.popleft()).number != answer.transaction:
            self._motion.miss(request.possible_counts_s)
        sent_s = request.sent_s
        now_s = self._answered_s = time.monotonic()
        self._check_unit_and_exception(answer)
        try:
            az, el, faults = decode_registers(answer.pdu, _FUNCTION, REGISTERS)
        except ValueError as error:
            raise self._opened().nonsense("three registers", str(error)) from None
        counts = self._count((az, el), now_s)
        if not self._motion.accept(sent_s, now_s, request.possible_counts_s, counts):
            return None
        self._counts, self._counted_s = counts, sent_s
        az_counts, el_counts = counts
        fault = "; ".join(
            f"{name}: fault line"
            for name, is_up in zip(AXES, lines(faults, self._device.fault_level), strict=True)
            if is_up
        )
        return ServoReading(
            time_s=(sent_s + now_s) / 2,
            position_rad=(az_counts * self._rad_per_count, el_counts * self._rad_per_count),
            enabled=self._enable and not fault,
            fault=fault,
        )

    def _check_unit_and_exception(self, answer: Answer) -> None:
        if answer.unit != self._device.device_id:
            got = f"unit {answer.unit}"
            raise self._opened().nonsense(f"unit {self._device.device_id}", got)
        if answer.pdu[0] == _FUNCTION:
            return
        code = decode_exception(answer.pdu, _FUNCTION)
        if code is not None:
            raise self._endpoint.error(
                DeviceRefused,
                f"function {_FUNCTION} to be carried out",
                f"exception {code:02X}, {EXCEPTIONS.get(code, 'see the station manual')}",
                "check device_id, first_output_register and first_input_register",
            )

    def _count(self, counters: tuple[int, int], now_s: float) -> tuple[int, int]:
        """Both counters, counted on across their wrap."""
        since_s = now_s - self._counted_s
        near = self._counts
        if near is None:
            return signed(counters[0]), signed(counters[1])
        if not math.isinf(since_s) and since_s > self._blind_s:
            expected = (
                f"a reading within {self._blind_s:.2f} s, for the counters not to wrap unseen"
            )
            raise self._timeout(expected, f"one after {since_s:.2f} s")
        return unwrap(counters[0], near[0]), unwrap(counters[1], near[1])

    # ------------------------------------------------------------ errors
    def _fault(self, expected: str, got: str) -> DeviceFault:
        hint = "look at the amplifier's lamps, remove the cause, then recover"
        return self._endpoint.error(DeviceFault, expected, got, hint)

    def _silent(self) -> DeviceTimeout:
        return self._timeout(f"an answer within {self._device.response_timeout_s:g} s", "none")

    def _timeout(self, expected: str, got: str) -> DeviceTimeout:
        hint = (
            "check the I/O station's power and load, and siderostat.device.device_id; then recover"
        )
        return self._endpoint.error(DeviceTimeout, expected, got, hint)


def _connect(device: BalAnalogDevice) -> ModbusLink:
    return ModbusLink(
        Endpoint(DEVICE, device.endpoint),
        device.host,
        device.port,
        unit=device.device_id,
        timeout_s=device.response_timeout_s,
        station="the I/O station",
        keys="siderostat.device",
    )


def probe_bal_analog(siderostat: Siderostat[BalAnalogDevice]) -> Probe:
    """Who a station is, and whether an amplifier behind it is in fault.

    Raises
    ------
    DeviceError
        If it does not answer, or has no such registers.
    """
    device = siderostat.device
    with closing(_connect(device)) as link:
        identity = link.identify()
        read = ReadHoldingRegistersRequest(address=device.first_input_register, count=REGISTERS)
        answer = link.ask(read)
        if not answer:
            expected = f"an answer within {device.response_timeout_s:g} s"
            hint = "check siderostat.device.device_id"
            raise DeviceTimeout(DEVICE, device.endpoint, expected, "none", hint)
        try:
            _, _, faults = decode_registers(answer, read.function_code, REGISTERS)
        except ValueError as error:
            hint = "check siderostat.device.first_input_register"
            raise DeviceRefused(
                DEVICE, device.endpoint, "three registers", str(error), hint
            ) from None
        question_s = round_trip_s(lambda: link.ask(read))
    disagreements = tuple(
        f"{name}'s fault line is up: look at the amplifier's lamps and remove the cause"
        for name, is_up in zip(AXES, lines(faults, device.fault_level), strict=True)
        if is_up
    )
    return Probe(identity, question_s, disagreements)
