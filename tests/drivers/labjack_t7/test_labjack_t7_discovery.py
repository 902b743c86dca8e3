"""LabJacks that answer by UDP."""

import socket
import struct
import threading
from contextlib import contextmanager

import pytest

from fitctl.drivers.interface import DeviceUnreachable
from fitctl.drivers.labjack_t7.discovery import discover_labjacks

T7 = {
    60000: struct.pack(">f", 7.0),
    60004: struct.pack(">f", 1.0312),
    60010: struct.pack(">I", 1),
    60028: struct.pack(">I", 470012345),
}


@contextmanager
def answering(respond):
    """A UDP socket whose answers are `respond(packet)`; its port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(2.0)
        requests = []

        def serve():
            for _ in range(4):
                packet, peer = station.recvfrom(64)
                requests.append(packet)
                for answer in respond(packet):
                    station.sendto(answer, peer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield station.getsockname()[1], requests
        finally:
            thread.join(5.0)


def answer(packet):
    transaction, protocol, _, unit, function, address, count = struct.unpack(">HHHBBHH", packet)
    assert (protocol, function, count) == (0, 3, 2)
    pdu = bytes([function, 4]) + T7[address]
    return struct.pack(">HHHB", transaction, 0, 1 + len(pdu), unit) + pdu


def test_a_t7_that_answers_is_found_with_its_identity():
    with answering(lambda packet: [answer(packet)]) as (port, requests):
        (found,) = discover_labjacks("127.0.0.1", 0.5, port=port)
    assert found.address == "127.0.0.1"
    assert (found.identity.maker, found.identity.model) == ("LabJack", "T7-Pro")
    assert found.identity.serial == "470012345"
    assert requests[0].hex(" ") == "00 00 00 00 00 06 01 03 ea 60 00 02"
    assert all(len(request) <= 64 for request in requests)


@pytest.mark.parametrize(
    "respond",
    [
        lambda _packet: [],
        lambda _packet: [b"", b"noise", bytes(64)],
        lambda packet: [answer(packet)[:-1]],
        lambda packet: [bytes([0xFF]) + answer(packet)[1:]],
        lambda packet: [answer(packet)] if packet[9] != 0x60 else [],  # PRODUCT_ID goes unanswered
        lambda packet: [packet[:7] + bytes([0x83, 2])],
    ],
)
def test_what_answers_otherwise_is_not_listed(respond):
    with answering(respond) as (port, _):
        assert discover_labjacks("127.0.0.1", 0.3, port=port) == []


def test_no_way_to_the_network_is_an_error():
    with pytest.raises(DeviceUnreachable, match="IPv4"):
        discover_labjacks("labjack.invalid..", 0.1)
