"""Where devices are addressed: IPv4 addresses, host names, serial ports and CAN interfaces."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from ipaddress import IPv4Address, ip_address
from typing import Annotated

from pydantic import AfterValidator

SOCKET_URL = "socket://"
# What serial drivers and their adapters can be set to.
_BAUD_RATES = """
    1200 2400 4800 9600 14400 19200 28800 38400 57600 76800 115200 128000 230400 250000 256000 460800 500000
    576000 921600 1000000 1152000 1500000 2000000 2500000 3000000 3500000 4000000
"""
BAUD_RATES = frozenset(map(int, _BAUD_RATES.split()))
# Of python-can; others come with programs that are installed beside it.
_CAN_INTERFACES = """
    canalystii cantact etas gs_usb iscan ixxat kvaser neousys neovi nican nixnet pcan robotell seeedstudio
    serial slcan socketcan systec usb2can vector virtual
"""
_UNFIT_CAN_INTERFACES = {
    "udp_multicast": "its frames can leave the machine",
    "socketcand": "it needs a host and a port beside the channel",
}
_LABEL = r"[A-Za-z0-9_](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST_NAME = re.compile(rf"(?=.{{1,253}}$){_LABEL}(?:\.{_LABEL})*\.?")
_HOST_AND_PORT = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^\[\]:/]+)):([0-9]{1,5})")
_SERIAL = re.compile(r"/[^\0-\x1f]+|COM[0-9]{1,3}")


def is_host(text: str) -> bool:
    """Whether a device can be at such a host: an address, or a name that is no attempt at an IPv4 address."""
    try:
        address = ip_address(text)
    except ValueError:
        looks_like_address = re.fullmatch(r"[0-9.]+", text) is not None
        return not looks_like_address and _HOST_NAME.fullmatch(text) is not None
    return not address.is_multicast and not address.is_unspecified


def is_socket_url(text: str) -> bool:
    """Whether the text is ``socket://host:port``."""
    match = _HOST_AND_PORT.fullmatch(text.removeprefix(SOCKET_URL))
    if match is None or not text.startswith(SOCKET_URL):
        return False
    in_brackets, host, port = match.groups()
    return is_host(in_brackets or host) and 1 <= int(port) <= 65535


def is_serial_port(text: str) -> bool:
    """Whether the text is the path of a serial port, its Windows name, or ``socket://host:port``."""
    return _SERIAL.fullmatch(text) is not None or is_socket_url(text)


def _ipv4(text: str) -> str:
    try:
        address = IPv4Address(text)
    except ValueError:
        address = None
    if address is None or address.is_multicast or address.is_unspecified or address.is_reserved:
        msg = "must be the IPv4 address of one device, four numbers from 0 to 255 such as 192.168.1.20"
        raise ValueError(msg)
    return text


def _host(text: str) -> str:
    if not is_host(text):
        msg = (
            "must be an address such as 192.168.1.30, or a host name, without a port; numbers of an IPv4 "
            "address go from 0 to 255"
        )
        raise ValueError(msg)
    return text


def _serial_port(text: str) -> str:
    if not is_serial_port(text):
        hint = f"; for this address, write {SOCKET_URL}{text}:PORT" if is_host(text) else ""
        msg = f"must be a serial port, such as /dev/ttyUSB0, or socket://host:port{hint}"
        raise ValueError(msg)
    return text


def _baud_rate(rate: int) -> int:
    if rate not in BAUD_RATES:
        near = sorted(sorted(BAUD_RATES, key=lambda one: abs(one - rate))[:3])
        msg = f"must be a baud rate that serial ports have, such as {', '.join(map(str, near))}"
        raise ValueError(msg)
    return rate


def _can_interface(name: str) -> str:
    if why := _UNFIT_CAN_INTERFACES.get(name):
        msg = f"must not be {name}: {why}; choose the interface of a CAN adapter"
        raise ValueError(msg)
    known = set(_CAN_INTERFACES.split())
    if name not in known:
        known |= {one.name for one in entry_points(group="can.interface")}
        if name not in known:
            msg = f"must be an interface of python-can: {', '.join(sorted(known))}"
            raise ValueError(msg)
    return name


Ipv4 = Annotated[str, AfterValidator(_ipv4)]
Host = Annotated[str, AfterValidator(_host)]
SerialPort = Annotated[str, AfterValidator(_serial_port)]
BaudRate = Annotated[int, AfterValidator(_baud_rate)]
CanInterface = Annotated[str, AfterValidator(_can_interface)]
