"""The camera's stream channel: where it sends, in packets of which size, how far apart."""

from __future__ import annotations

import contextlib
import select
import socket
import time

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.interface import DeviceMismatch, DeviceRefused, DeviceUnreachable

RECEIVE_BUFFER_BYTES = 4 << 20  # the kernel grants what net.core.rmem_max allows
_SMALLEST_BYTES = 576  # what every network passes
_TESTS = 3
_TEST_S = 0.05
_PACKET_BYTES_MAX = 65536
_LARGEST_REGISTER = 0xFFFFFFFF


def open_stream(channel: ControlChannel) -> socket.socket:
    """A socket that the camera sends its stream to."""
    stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        stream.setblocking(False)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        _bind(channel, stream)
        host, port = stream.getsockname()
        address = int.from_bytes(socket.inet_aton(host), "big")
        channel.write_register(Register.STREAM_DESTINATION, address)
        channel.write_register(Register.STREAM_PORT, port)
    except BaseException:
        stream.close()
        raise
    return stream


def _bind(channel: ControlChannel, stream: socket.socket) -> None:
    """To the address from which the camera is reached, which the host may have lost meanwhile."""
    try:
        stream.bind((channel.local_address, 0))
    except OSError as error:
        raise channel.endpoint.error(
            DeviceUnreachable,
            f"the host to receive at {channel.local_address}",
            str(error),
            "check the network interface that leads to the camera",
        ) from error


def set_packet_size(channel: ControlChannel, size_bytes: int) -> None:
    """Set the size of stream packets, IP and UDP headers included. Raises DeviceMismatch."""
    flagged = size_bytes | protocol.PACKET_SIZE_DO_NOT_FRAGMENT
    try:
        channel.write_register(Register.STREAM_PACKET_SIZE, flagged)
        value = channel.read_register(Register.STREAM_PACKET_SIZE)
        got = f"{value & protocol.PACKET_SIZE_MASK} bytes"
    except DeviceRefused as error:
        got = error.got
    if got != f"{size_bytes} bytes":
        raise channel.endpoint.error(
            DeviceMismatch,
            f"packets of {size_bytes} bytes",
            got,
            "correct camera.device.packet_size_bytes in the rig file; a multiple of 4 is usual",
        )


def check_path(channel: ControlChannel, size_bytes: int) -> None:
    """Have test packets sent; the size that is set stays.

    A camera that sends none, and a firewall that passes none, leave the question open.

    Raises
    ------
    DeviceMismatch
        If small packets arrive, and those of this size do not.
    """
    if size_bytes == _SMALLEST_BYTES:
        return
    with open_stream(channel) as stream:
        fits = _arrives(channel, stream, size_bytes)
        small_fits = not fits and _arrives(channel, stream, _SMALLEST_BYTES)
    channel.write_register(Register.STREAM_PORT, 0)
    set_packet_size(channel, size_bytes)
    if small_fits:
        raise channel.endpoint.error(
            DeviceMismatch,
            f"packets of {size_bytes} bytes to pass the network",
            f"packets of {_SMALLEST_BYTES} bytes only",
            "lower camera.device.packet_size_bytes in the rig file, or switch on jumbo frames all the way",
        )


def set_packet_delay(channel: ControlChannel, delay_s: float, ticks_per_s: int) -> None:
    """Set the least time between two packets, which the camera counts in ticks of its clock.

    Raises
    ------
    DeviceMismatch
        If the camera refuses it, or has no clock that can count it. No delay is always right.
    """
    got = "" if ticks_per_s else "a camera without a clock to count it"
    ticks = round(delay_s * ticks_per_s)
    if ticks > _LARGEST_REGISTER:
        got, ticks = f"a camera with a clock of {ticks_per_s} Hz, too fast to count it", 0
    try:
        channel.write_register(Register.STREAM_PACKET_DELAY, ticks)
    except DeviceRefused as error:
        got = error.got
    if got and delay_s:
        raise channel.endpoint.error(
            DeviceMismatch,
            f"a delay of {delay_s:g} s between packets",
            got,
            "set camera.device.packet_delay_s = 0.0 in the rig file",
        )


def _arrives(channel: ControlChannel, stream: socket.socket, size_bytes: int) -> bool:
    fire = size_bytes | protocol.PACKET_SIZE_DO_NOT_FRAGMENT | protocol.PACKET_SIZE_FIRE_TEST
    poll = select.poll()
    poll.register(stream, select.POLLIN)
    for _ in range(_TESTS):
        try:
            channel.write_register(Register.STREAM_PACKET_SIZE, fire)
        except DeviceRefused:
            return False
        deadline_s = time.monotonic() + _TEST_S
        while (left_s := deadline_s - time.monotonic()) > 0 and poll.poll(left_s * 1000):
            length = 0
            with contextlib.suppress(BlockingIOError):  # its checksum was wrong
                length = len(stream.recv(_PACKET_BYTES_MAX))
            if length == size_bytes - protocol.TEST_PACKET_OVERHEAD_BYTES:
                return True
    return False
