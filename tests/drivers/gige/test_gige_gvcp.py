"""The control channel against a scripted device: each test is a transcript of the wire."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest

from fitctl.drivers.gige import protocol as p
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.interface import (
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

READ = p.encode_words(p.Register.CONTROL_PRIVILEGE)
VALUE = p.encode_words(2)
ACK = p.Command.READREG + 1


class Script:
    """A device that answers the n-th command with the n-th list of answers; ids are filled in."""

    def __init__(self, *answers: list[tuple[int, bytes, int]]) -> None:
        self.commands: list[p.CommandPacket] = []
        self._answers = answers
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(5)
        self.port = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._play)
        self._thread.start()

    def _play(self) -> None:
        for answers in self._answers:
            packet, sender = self._socket.recvfrom(2048)
            command = p.decode_command(packet)
            self.commands.append(command)
            for number, payload, status in answers:
                answer = p.encode_answer(number, command.request_id, payload, status)
                self._socket.sendto(answer, sender)

    def close(self) -> None:
        self._thread.join()
        self._socket.close()


@pytest.fixture
def scripts() -> Iterator[list[Script]]:
    opened: list[Script] = []
    yield opened
    for script in opened:
        script.close()


def read_privilege(scripts: list[Script], *answers: list[tuple[int, bytes, int]]) -> int:
    scripts.append(Script(*answers))
    channel = ControlChannel("127.0.0.1", scripts[-1].port, timeout_s=0.6)
    try:
        return channel.read_register(p.Register.CONTROL_PRIVILEGE)
    finally:
        channel.close()


def test_a_register_is_read(scripts: list[Script]) -> None:
    assert read_privilege(scripts, [(ACK, VALUE, 0)]) == 2
    (command,) = scripts[0].commands
    assert (command.command, command.payload, command.flags) == (p.Command.READREG, READ, 1)


def test_a_lost_answer_is_asked_for_again_with_the_same_id(scripts: list[Script]) -> None:
    assert read_privilege(scripts, [], [], [(ACK, VALUE, 0)]) == 2
    assert len({command.request_id for command in scripts[0].commands}) == 1


def test_three_lost_answers_are_a_timeout(scripts: list[Script]) -> None:
    with pytest.raises(DeviceTimeout, match=r"READREG within 0\.6 s"):
        read_privilege(scripts, [], [], [])


def test_a_pending_ack_is_waited_for(scripts: list[Script]) -> None:
    pending = (p.PENDING_ACK, bytes.fromhex("0000 0064"), 0)
    assert read_privilege(scripts, [pending, (ACK, VALUE, 0)]) == 2


def test_pending_acks_of_all_attempts_share_one_limit(
    scripts: list[Script], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fitctl.drivers.gige.gvcp.PENDING_LIMIT_S", 1.5)
    pending = (p.PENDING_ACK, bytes.fromhex("0000 FFFF"), 0)
    begun_s = time.monotonic()
    with pytest.raises(DeviceTimeout):
        read_privilege(scripts, [pending], [pending], [pending])
    assert 2.0 < time.monotonic() - begun_s < 4.0  # 0.6 s + 1.5 s, not 0.6 s + 3 * 1.5 s


@pytest.mark.parametrize("address", ["ä..", "a\0", "camera.example", "127.1", ""])
def test_what_is_no_ipv4_address_is_unreachable_and_says_where_to_correct_it(address: str) -> None:
    with pytest.raises(DeviceUnreachable, match=r"IPv4.*correct camera\.device\.address"):
        ControlChannel(address, p.GVCP_PORT, timeout_s=0.6)


def test_an_error_status_is_a_refusal_that_names_the_register(scripts: list[Script]) -> None:
    with pytest.raises(DeviceRefused, match=r"READREG 0x00000A00.*0x8003 INVALID_ADDRESS"):
        read_privilege(scripts, [(ACK, b"", p.Status.INVALID_ADDRESS)])


@pytest.mark.parametrize("answer", [(0x85, VALUE, 0), (ACK, VALUE + VALUE, 0), (ACK, b"", 0)])
def test_the_wrong_answer_is_a_protocol_error(
    scripts: list[Script], answer: tuple[int, bytes, int]
) -> None:
    with pytest.raises(DeviceProtocolError):
        read_privilege(scripts, [answer])


def test_memory_is_read_in_pieces_of_512_bytes(scripts: list[Script]) -> None:
    pieces = [(0x1000, 512), (0x1200, 512), (0x1400, 8)]
    script = Script(
        *[[(p.Command.READMEM + 1, p.encode_words(a) + bytes(n), 0)] for a, n in pieces]
    )
    scripts.append(script)
    channel = ControlChannel("127.0.0.1", script.port, timeout_s=0.6)
    assert channel.read_memory(0x1000, 1030) == bytes(1030)
    channel.close()
    assert [p.decode_readmem(command.payload) for command in script.commands] == pieces


def test_memory_from_another_address_is_passed_over(scripts: list[Script]) -> None:
    other = (p.Command.READMEM + 1, p.encode_words(0x2000, 1), 0)
    wanted = (p.Command.READMEM + 1, p.encode_words(0x1000, 2), 0)
    scripts.append(Script([other], [other, wanted]))
    channel = ControlChannel("127.0.0.1", scripts[-1].port, timeout_s=0.6)
    assert channel.read_memory(0x1000, 4) == p.encode_words(2)
    channel.close()


def test_what_expects_no_answer_asks_for_none(scripts: list[Script]) -> None:
    script = Script([], [])
    scripts.append(script)
    channel = ControlChannel("127.0.0.1", script.port, timeout_s=0.1)
    try:
        channel.request_resend(p.Resend(0, 7, 2, 5))
        channel.release_unheard()
        script.close()
    finally:
        channel.close()
    resend, release = script.commands
    assert (resend.command, resend.flags) == (p.Command.PACKETRESEND, 0)
    assert resend.payload == p.encode_resend(p.Resend(0, 7, 2, 5))
    assert (release.command, release.flags) == (p.Command.WRITEREG, 0)
    assert release.payload == p.encode_words(p.Register.CONTROL_PRIVILEGE, 0)
