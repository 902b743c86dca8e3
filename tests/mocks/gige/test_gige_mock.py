"""The mock camera at its GVCP socket's doorstep: datagrams in, datagrams out."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige import protocol as p
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.gige.memory import Feature

ME = ("127.0.0.1", 40001)
OTHER = ("127.0.0.1", 40002)


@asynccontextmanager
async def started() -> AsyncIterator[GigeCameraMock]:
    camera = load_rig(default_rig_path()).camera
    mock = GigeCameraMock(camera, lambda _: np.zeros((40, 40), np.uint16), port=0)
    await mock.start()
    try:
        yield mock
    finally:
        await mock.stop()


def ask(
    mock: GigeCameraMock, command: int, payload: bytes = b"", sender: tuple[str, int] = ME
) -> p.AnswerPacket:
    reply = mock.answer(p.encode_command(command, 5, payload), sender)
    assert reply is not None
    answer = p.decode_answer(reply)
    assert (answer.command, answer.request_id) == (command + 1, 5)
    return answer


def write(mock: GigeCameraMock, register: int, value: int, sender: tuple[str, int] = ME) -> int:
    return ask(mock, p.Command.WRITEREG, p.encode_words(register, value), sender).status


def read(mock: GigeCameraMock, register: int, sender: tuple[str, int] = ME) -> int:
    answer = ask(mock, p.Command.READREG, p.encode_words(register), sender)
    return p.decode_words(answer.payload)[0] if answer.payload else answer.status


def scenario(test: Callable[[GigeCameraMock], Coroutine[Any, Any, None] | None]) -> None:
    async def run() -> None:
        async with started() as mock:
            result = test(mock)
            if result is not None:
                await result

    asyncio.run(run())


def test_discovery_answers_with_the_first_registers() -> None:
    def check(mock: GigeCameraMock) -> None:
        payload = ask(mock, p.Command.DISCOVERY).payload
        assert len(payload) == 0xF8
        assert payload[0x48:0x4C] == b"FIT\0"
        assert payload[0xD8:0xDE] == b"FIT01\0"

    scenario(check)


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (p.Command.READREG, "0000b000", p.Status.INVALID_ADDRESS),
        (p.Command.READREG, "00000a04", p.Status.INVALID_ADDRESS),
        (p.Command.READREG, "00000a01", p.Status.BAD_ALIGNMENT),
        (p.Command.READREG, "", p.Status.INVALID_HEADER),
        (p.Command.READMEM, "00000048 0000 0204", p.Status.INVALID_PARAMETER),
        (p.Command.READMEM, "00000048 0000 0003", p.Status.BAD_ALIGNMENT),
        (p.Command.WRITEREG, "00000000 00000001", p.Status.WRITE_PROTECT),
        (p.Command.WRITEREG, "0000b000 00000001", p.Status.INVALID_ADDRESS),
        (p.Command.WRITEREG, "0000a000 00000029", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEREG, "0000a010 01080001", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEREG, "00000d18 08080808", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEMEM, "0000a038 40a77000 00000000", p.Status.INVALID_PARAMETER),  # 3000 Hz
        (p.Command.FORCEIP, "", p.Status.NOT_IMPLEMENTED),
    ],
)
def test_what_a_camera_cannot_do_has_its_status(
    command: int, payload: str, status: p.Status
) -> None:
    def check(mock: GigeCameraMock) -> None:
        assert write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL) == p.Status.SUCCESS
        assert ask(mock, command, bytes.fromhex(payload)).status == status

    scenario(check)


def test_a_refused_value_leaves_the_register_as_it_was() -> None:
    def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        write(mock, Feature.WIDTH, 41)
        assert read(mock, Feature.WIDTH) == 40

    scenario(check)


def test_without_control_nothing_can_be_written() -> None:
    def check(mock: GigeCameraMock) -> None:
        assert write(mock, Feature.WIDTH, 32) == p.Status.ACCESS_DENIED

    scenario(check)


def test_with_control_others_may_read_and_with_exclusive_control_they_may_not() -> None:
    def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        assert write(mock, p.Register.CONTROL_PRIVILEGE, 2, OTHER) == p.Status.ACCESS_DENIED
        assert read(mock, Feature.WIDTH, OTHER) == 40
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL_EXCLUSIVE)
        assert read(mock, Feature.WIDTH, OTHER) == p.Status.ACCESS_DENIED
        write(mock, p.Register.CONTROL_PRIVILEGE, 0)
        assert write(mock, p.Register.CONTROL_PRIVILEGE, 2, OTHER) == p.Status.SUCCESS

    scenario(check)


def test_the_image_format_is_locked_while_frames_are_taken() -> None:
    def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        write(mock, Feature.ACQUISITION_START, 1)
        assert write(mock, Feature.WIDTH, 32) == p.Status.ACCESS_DENIED
        write(mock, Feature.ACQUISITION_STOP, 1)
        assert write(mock, Feature.WIDTH, 32) == p.Status.SUCCESS
        assert read(mock, Feature.PAYLOAD_SIZE) == 2 * 32 * 40

    scenario(check)


def test_the_xml_url_leads_to_the_description() -> None:
    def check(mock: GigeCameraMock) -> None:
        text = ask(mock, p.Command.READMEM, p.encode_readmem(p.Register.XML_URL_1, 512)).payload
        location = p.decode_xml_url(text[4:].split(b"\0")[0].decode())
        head = ask(mock, p.Command.READMEM, p.encode_readmem(location.address, 40)).payload[4:]
        assert head.startswith(b"<?xml")
        past = p.encode_readmem(location.address + location.length, 4)
        assert ask(mock, p.Command.READMEM, past).status == p.Status.INVALID_ADDRESS

    scenario(check)


def test_a_test_packet_has_the_size_that_was_asked_for() -> None:
    async def check(mock: GigeCameraMock) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", 0))
            client.settimeout(2)
            write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
            write(mock, p.Register.STREAM_DESTINATION, 0x7F000001)
            write(mock, p.Register.STREAM_PORT, client.getsockname()[1])
            write(mock, p.Register.STREAM_PACKET_SIZE, p.PACKET_SIZE_FIRE_TEST | 1400)
            assert len(client.recv(2048)) == 1400 - 28
        assert read(mock, p.Register.STREAM_PACKET_SIZE) == 1400

    scenario(check)


def test_a_frame_that_is_gone_is_answered_as_unavailable() -> None:
    async def check(mock: GigeCameraMock) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", 0))
            client.settimeout(2)
            write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
            write(mock, p.Register.STREAM_DESTINATION, 0x7F000001)
            write(mock, p.Register.STREAM_PORT, client.getsockname()[1])
            write(mock, Feature.ACQUISITION_START, 1)
            resend = p.encode_resend(p.Resend(0, 9999, 1, 2))
            assert mock.answer(p.encode_command(0x40, 6, resend, flags=0), ME) is None
            header = p.decode_stream_header(client.recv(2048))
        assert header == p.StreamHeader(p.Status.PACKET_UNAVAILABLE, 9999, p.FORMAT_PAYLOAD, 1)

    scenario(check)


def test_a_mock_that_was_held_up_sends_every_frame_late_and_says_so() -> None:
    async def check(mock: GigeCameraMock) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", 0))
            client.setblocking(False)
            write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
            write(mock, p.Register.STREAM_DESTINATION, 0x7F000001)
            write(mock, p.Register.STREAM_PORT, client.getsockname()[1])
            write(mock, Feature.ACQUISITION_START, 1)
            time.sleep(0.3)  # the event loop stands still
            loop = asyncio.get_running_loop()
            blocks = set()
            while len(blocks) < 7:
                packet = await asyncio.wait_for(loop.sock_recv(client, 2048), 2)
                blocks.add(p.decode_stream_header(packet).block_id)
        assert blocks == {1, 2, 3, 4, 5, 6, 7}
        assert mock.acquisition.late_frames >= 6
        assert mock.acquisition.worst_late_s > 0.2

    scenario(check)


@settings(max_examples=200, deadline=None)
@given(
    packets=st.lists(
        st.binary(max_size=40)
        | st.builds(
            p.encode_command,
            st.sampled_from([*p.Command, 0x99]),
            st.integers(1, 65535),
            st.binary(max_size=24),
        ),
        max_size=5,
    )
)
def test_whatever_comes_the_mock_answers_or_is_silent(packets: list[bytes]) -> None:
    def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        for packet in packets:
            mock.answer(packet, ME)
        assert ask(mock, p.Command.DISCOVERY).status == p.Status.SUCCESS

    scenario(check)


def test_a_taken_port_is_an_error_and_nothing_stays_open() -> None:
    async def check(mock: GigeCameraMock) -> None:
        assert mock._endpoint is not None
        camera = load_rig(default_rig_path()).camera
        second = GigeCameraMock(
            camera, lambda _: np.zeros((40, 40), np.uint16), port=mock._endpoint.port
        )
        with pytest.raises(OSError, match="ddress already in use"):
            await second.start()
        await second.stop()

    scenario(check)
