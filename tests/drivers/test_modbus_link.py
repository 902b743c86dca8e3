"""The Modbus/TCP connection on which nobody waits."""

import socket
import threading
import time

import pytest
from pymodbus.pdu import ReadHoldingRegistersRequest
from scripted_server import scripted_server

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceProtocolError, DeviceUnreachable
from fitctl.drivers.modbus_tcp import ModbusLink
from fitctl.mocks.modbus.tcp import frame


def link_to(port):
    return ModbusLink(
        Endpoint("device", f"127.0.0.1:{port}"),
        "127.0.0.1",
        port,
        unit=1,
        timeout_s=0.25,
        station="the station",
        keys="some.device",
    )


def request():
    return ReadHoldingRegistersRequest(address=0, count=1)


def answer_at_once(client):
    while data := client.recv(12):
        client.sendall(frame(int.from_bytes(data[:2], "big"), 1, bytes.fromhex("03 02 00 07")))


@pytest.mark.usefixtures("kernel_stamps")
def test_an_answer_is_dated_by_its_arrival_however_late_it_is_read():
    with scripted_server(answer_at_once) as port:
        link = link_to(port)
        sent_s = time.monotonic()
        number = link.send(request())
        threading.Event().wait(0.3)
        answer = link.receive(0.0)
        read_s = time.monotonic()
        link.close()
    assert answer.transaction == number
    assert sent_s < link.arrived_s < read_s - 0.1


def test_without_an_answer_receive_returns_at_its_deadline_and_at_once_if_that_has_passed():
    with scripted_server(lambda client: client.recv(1000)) as port:
        link = link_to(port)
        started_s = time.monotonic()
        assert link.receive(0.0) is None
        assert time.monotonic() - started_s < 0.05
        assert link.receive(started_s + 0.2) is None
        assert 0.19 < time.monotonic() - started_s < 1.0
        link.close()


def send_until_full(link, took_s):
    while True:
        started_s = time.monotonic()
        try:
            link.send(request())
        finally:
            took_s.append(time.monotonic() - started_s)


def test_a_station_that_reads_nothing_is_unreachable_and_nobody_waits_for_it():
    took_s = []
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link = link_to(deaf.getsockname()[1])
        link._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        with pytest.raises(DeviceUnreachable, match="check the power and the cable of the station"):
            send_until_full(link, took_s)
    assert max(took_s) < 0.2  # with a wait it would be the link's 0.25 s


def answer_without_end(client):
    while True:
        client.sendall(frame(0xFFFF, 1, bytes.fromhex("03 02 00 07")))


def test_a_station_that_answers_without_end_is_given_up():
    with scripted_server(answer_without_end) as port:
        link = link_to(port)
        with pytest.raises(DeviceProtocolError, match="one answer to a request, got more"):
            link.ask(request())


def test_a_station_that_answers_everything_twice_is_not_given_up():
    def answer_twice(client):
        while data := client.recv(12):
            number = int.from_bytes(data[:2], "big")
            client.sendall(2 * frame(number, 1, bytes.fromhex("03 02 00 07")))

    with scripted_server(answer_twice) as port:
        link = link_to(port)
        answers = [link.ask(request()) for _ in range(300)]
        link.close()
    assert answers == 300 * [bytes.fromhex("03 02 00 07")]


def test_answers_that_all_come_late_are_none_too_many():
    def answer_late(client):
        numbers = [client.recv(12)[:2] for _ in range(300)]
        for number in numbers:
            client.sendall(frame(int.from_bytes(number, "big"), 1, bytes.fromhex("03 02 00 07")))
        client.recv(1)

    with scripted_server(answer_late) as port:
        link = link_to(port)
        sent = [link.send(request()) for _ in range(300)]
        received = [link.receive(time.monotonic() + 5.0).transaction for _ in range(300)]
        link.close()
    assert received == sent
