"""Which LabJack T-series devices are in the network: answers to Modbus requests by UDP broadcast.

LabJack's T-Series Datasheet, section 6: port 52362 answers Modbus UDP packets of at most 64 bytes, and is
what LabJack's own programs search by.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import NamedTuple

from pymodbus.pdu import ReadHoldingRegistersRequest

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceIdentity, DeviceUnreachable
from fitctl.drivers.labjack_t7 import protocol
from fitctl.drivers.labjack_t7.link import DEVICE, Facts
from fitctl.drivers.modbus import TCP, decode_registers, pop_answer

UDP_PORT = 52362
_UNIT = 1
_ASKED = (
    protocol.PRODUCT_ID,
    protocol.FIRMWARE_VERSION,
    protocol.HARDWARE_INSTALLED,
    protocol.SERIAL_NUMBER,
)
"""A request each, whose transaction number is its place here: together they would not fit into a packet."""
_ANSWER_BYTES_MAX = 64


class FoundLabJack(NamedTuple):
    """A LabJack that answered all questions."""

    address: str
    identity: DeviceIdentity


def discover_labjacks(
    destination: str, wait_s: float, *, port: int = UDP_PORT
) -> list[FoundLabJack]:
    """Ask one LabJack, or all that a broadcast reaches, who they are.

    Parameters
    ----------
    destination : str
        IPv4 address of a device, or of a broadcast, such as 255.255.255.255.
    wait_s : float
        How long answers are waited for.
    port : int

    Raises
    ------
    DeviceUnreachable
        If the host has no way to the destination.
    """
    told: dict[str, dict[int, float]] = {}
    deadline_s = time.monotonic() + wait_s
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            for number, register in enumerate(_ASKED):
                request = ReadHoldingRegistersRequest(
                    address=register.address, count=register.count, dev_id=_UNIT
                )
                request.transaction_id = number
                asking.sendto(TCP.buildFrame(request), (destination, port))
        except OSError as error:
            raise Endpoint(DEVICE, f"{destination}:{port}").error(
                DeviceUnreachable,
                "a network with LabJacks",
                str(error),
                "give an IPv4 address of that network, or its broadcast address",
            ) from error
        while (left_s := deadline_s - time.monotonic()) > 0:
            asking.settimeout(left_s)
            with contextlib.suppress(TimeoutError, ConnectionError, ValueError):
                packet, (address, _) = asking.recvfrom(_ANSWER_BYTES_MAX)
                number, value = _decoded(packet)
                told.setdefault(address, {})[number] = value
    return [
        FoundLabJack(address, _identity(values))
        for address, values in sorted(told.items(), key=lambda item: socket.inet_aton(item[0]))
        if len(values) == len(_ASKED)
    ]


def _decoded(packet: bytes) -> tuple[int, float]:
    """Which question a packet answers, and the value. Raises ValueError."""
    answer = pop_answer(bytearray(packet))
    if answer is None or answer.transaction >= len(_ASKED):
        msg = "no answer to a question that was asked"
        raise ValueError(msg)
    register = _ASKED[answer.transaction]
    registers = decode_registers(
        answer.pdu, ReadHoldingRegistersRequest.function_code, register.count
    )
    return answer.transaction, protocol.decode(register, registers)


def _identity(values: dict[int, float]) -> DeviceIdentity:
    product, firmware, installed, serial = (values[number] for number in range(len(_ASKED)))
    pro = bool(int(installed) & protocol.HIGH_RESOLUTION)
    return Facts(product, firmware, int(serial), pro).identity
