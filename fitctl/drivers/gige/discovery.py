"""Who is there: the answers to a DISCOVERY."""

from __future__ import annotations

import contextlib
import socket
import time
from typing import NamedTuple

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.gvcp import DEVICE, text_of
from fitctl.drivers.gige.protocol import Command, MalformedPacketError, Register, TextRegister
from fitctl.drivers.interface import DeviceIdentity, DeviceUnreachable

_REQUEST_ID = 1
_ANSWER_BYTES_MAX = 2048


class FoundCamera(NamedTuple):
    """A camera that answered.

    Attributes
    ----------
    address : str
        The IPv4 address that it reports; not always one that this host can reach.
    mac : str
    user_name : str
        What its owner has called it; may be empty.
    identity : DeviceIdentity
    """

    address: str
    mac: str
    user_name: str
    identity: DeviceIdentity


def discover(
    destination: str, wait_s: float, *, source: str = "", port: int = protocol.GVCP_PORT
) -> list[FoundCamera]:
    """Ask one camera, or all that a broadcast reaches, who they are.

    Parameters
    ----------
    destination : str
        IPv4 address of a camera, or of a broadcast, such as 255.255.255.255.
    wait_s : float
        How long answers are waited for. Cameras may take up to a second.
    source : str
        This host's address on the interface on which a broadcast shall leave; empty leaves that to the
        routing table.
    port : int

    Returns
    -------
    list of FoundCamera
        By address; the same camera once.

    Raises
    ------
    DeviceUnreachable
        If the host has no way to the destination.
    """
    found = {}
    deadline_s = time.monotonic() + wait_s
    flags = protocol.FLAG_ACKNOWLEDGE | protocol.FLAG_BROADCAST_ACKNOWLEDGE
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            asking.bind((source, 0))
            packet = protocol.encode_command(Command.DISCOVERY, _REQUEST_ID, flags=flags)
            asking.sendto(packet, (socket.inet_ntoa(socket.inet_aton(destination)), port))
        except OSError as error:
            raise DeviceUnreachable(
                DEVICE,
                f"{destination}:{port}",
                "a network with cameras",
                str(error),
                "give an IPv4 address of that network, or its broadcast address",
            ) from error
        while (left_s := deadline_s - time.monotonic()) > 0:
            asking.settimeout(left_s)
            with contextlib.suppress(TimeoutError, ConnectionError, MalformedPacketError):
                camera = decode_found(asking.recv(_ANSWER_BYTES_MAX))
                found[camera.mac, camera.address] = camera
    return sorted(found.values(), key=lambda camera: socket.inet_aton(camera.address))


def decode_found(packet: bytes) -> FoundCamera:
    """Read the answer to a DISCOVERY. Raises MalformedPacketError."""
    answer = protocol.decode_answer(packet)
    expected = (Command.DISCOVERY + 1, protocol.Status.SUCCESS, protocol.DISCOVERY_BYTES)
    if (answer.command, answer.status, len(answer.payload)) != expected:
        msg = f"command 0x{answer.command:04X}, {protocol.status_name(answer.status)}"
        raise MalformedPacketError(msg)
    payload = answer.payload
    return FoundCamera(
        address=socket.inet_ntoa(payload[Register.IP_ADDRESS : Register.IP_ADDRESS + 4]),
        mac=payload[Register.MAC_HIGH + 2 : Register.MAC_LOW + 4].hex(":"),
        user_name=_text(payload, protocol.USER_NAME),
        identity=DeviceIdentity(
            maker=_text(payload, protocol.MAKER),
            model=_text(payload, protocol.MODEL),
            serial=_text(payload, protocol.SERIAL_NUMBER),
            firmware=_text(payload, protocol.DEVICE_VERSION),
        ),
    )


def _text(payload: bytes, register: TextRegister) -> str:
    return text_of(payload[register.address : register.address + register.length])
