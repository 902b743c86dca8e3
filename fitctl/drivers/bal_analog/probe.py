"""An I/O station asked: its outputs stay as they are."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import BalAnalogDevice, Siderostat
from fitctl.drivers.amplifiers import AXES, DEVICE
from fitctl.drivers.bal_analog.link import ModbusLink
from fitctl.drivers.bal_analog.protocol import (
    decode_registers,
    encode_read,
    lines,
)
from fitctl.drivers.interface import DeviceRefused, DeviceTimeout
from fitctl.drivers.modbus import READ_HOLDING_REGISTERS
from fitctl.drivers.probe import Probe, round_trip_s


def probe_bal_analog(siderostat: Siderostat[BalAnalogDevice]) -> Probe:
    """Who a station is, and whether an amplifier behind it is in fault.

    Raises
    ------
    DeviceError
        If it does not answer, or has no such registers.
    """
    device = siderostat.device
    with closing(ModbusLink(device)) as link:
        identity = link.identify()
        read = encode_read(device.first_input_register)
        answer = link.ask(read)
        if not answer:
            expected = f"an answer within {device.response_timeout_s:g} s"
            hint = "check siderostat.device.device_id"
            raise DeviceTimeout(DEVICE, device.endpoint, expected, "none", hint)
        try:
            _, _, faults = decode_registers(answer, READ_HOLDING_REGISTERS)
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
