"""The mock camera at its GVCP socket's doorstep: datagrams in, datagrams out."""

from __future__ import annotations

import asyncio
import socket

import pytest
from gige_asked import ME, OTHER, ask, camera_mock, read, received, scenario, write
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import Fault
from fitctl.drivers.gige import protocol as p
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.gige.memory import MAC, TICKS_PER_S, Feature


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
        pytest.param(p.Command.READREG, "00" * 544, p.Status.INVALID_HEADER, id="544 bytes"),
        (p.Command.READMEM, "00000048 0000", p.Status.INVALID_HEADER),
        (p.Command.READMEM, "00000048 0000 021c", p.Status.INVALID_PARAMETER),
        (p.Command.READMEM, "00000048 0000 0000", p.Status.INVALID_PARAMETER),
        (p.Command.READMEM, "0000b000 0000 0004", p.Status.INVALID_ADDRESS),
        (p.Command.READMEM, "00000048 0000 0003", p.Status.BAD_ALIGNMENT),
        (p.Command.WRITEREG, "00000000 00000001", p.Status.WRITE_PROTECT),
        (p.Command.WRITEREG, "0000b000 00000001", p.Status.INVALID_ADDRESS),
        (p.Command.WRITEREG, "0000a000 00000029", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEREG, "0000a010 010c0006", p.Status.INVALID_PARAMETER),  # Mono12Packed
        (p.Command.WRITEREG, "0000a050 00000002", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEREG, "0000a04c 00000000", p.Status.INVALID_PARAMETER),  # half a number
        (p.Command.WRITEREG, "00000a00", p.Status.INVALID_HEADER),
        (p.Command.WRITEMEM, "00000a", p.Status.INVALID_HEADER),
        (p.Command.WRITEMEM, "000000e8", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEMEM, "000000e8 464954", p.Status.BAD_ALIGNMENT),
        (p.Command.WRITEMEM, "00000048 46495400", p.Status.WRITE_PROTECT),
        (p.Command.WRITEMEM, "0000b000 00000000", p.Status.INVALID_ADDRESS),
        (p.Command.WRITEMEM, "0000a048 40390000 00000000", p.Status.INVALID_PARAMETER),  # 25 dB
        (p.Command.WRITEMEM, "0000a030 7ff80000 00000000", p.Status.INVALID_PARAMETER),  # NaN us
        (p.Command.WRITEMEM, "0000a03c 00000000", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEREG, "00000d18 08080808", p.Status.INVALID_PARAMETER),
        (p.Command.WRITEMEM, "0000a038 40a77000 00000000", p.Status.INVALID_PARAMETER),  # 3000 Hz
        (p.Command.FORCEIP, "", p.Status.INVALID_HEADER),
        (0x0100, "00" * 12, p.Status.NOT_IMPLEMENTED),  # ACTION
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


@pytest.mark.parametrize(("description", "begins"), [("xml", b"<?xml"), ("zip", b"PK")])
def test_the_xml_url_leads_to_the_description(description: str, begins: bytes) -> None:
    def check(mock: GigeCameraMock) -> None:
        text = ask(mock, p.Command.READMEM, p.encode_readmem(p.Register.XML_URL_1, 512)).payload
        location = p.decode_xml_url(text[4:].split(b"\0")[0].decode())
        head = ask(mock, p.Command.READMEM, p.encode_readmem(location.address, 40)).payload[4:]
        assert head.startswith(begins)
        past = p.encode_readmem(location.address + location.length + 4 & ~3, 4)
        assert ask(mock, p.Command.READMEM, past).status == p.Status.INVALID_ADDRESS

    scenario(check, description=description)


def test_the_clock_is_latched_and_reset() -> None:
    def check(mock: GigeCameraMock) -> None:
        def latched() -> int:
            write(mock, p.Register.TIMESTAMP_CONTROL, p.TIMESTAMP_LATCH)
            high = read(mock, p.Register.TIMESTAMP_HIGH)
            return high << 32 | read(mock, p.Register.TIMESTAMP_LOW)

        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        first = latched()
        assert first > 999 * TICKS_PER_S
        assert read(mock, p.Register.TIMESTAMP_LOW) == first & 0xFFFFFFFF  # until the next
        assert first < latched() < first + TICKS_PER_S
        write(mock, p.Register.TIMESTAMP_CONTROL, p.TIMESTAMP_RESET)
        assert latched() < TICKS_PER_S

    scenario(check)


def test_forceip_is_heard_by_whom_it_is_for_and_changes_nothing() -> None:
    def check(mock: GigeCameraMock) -> None:
        def force(mac: bytes, address: bytes) -> bytes | None:
            payload = bytes(2) + mac + bytes(12) + address + bytes(32)
            return mock.answer(p.encode_command(p.Command.FORCEIP, 5, payload), ME)

        assert force(bytes(6), bytes(4)) is None
        refused = force(MAC, bytes((127, 0, 0, 2)))
        assert refused == bytes.fromhex("8006 0005 0000 0005")
        assert force(MAC, bytes((127, 0, 0, 1))) == bytes.fromhex("0000 0005 0000 0005")
        assert read(mock, p.Register.IP_ADDRESS) == 0x7F000001

    scenario(check)


@pytest.mark.parametrize("number", [p.Command.READREG + 1, p.PENDING_ACK, 0xFFFF])
def test_an_acknowledge_is_not_answered(number: int) -> None:
    def check(mock: GigeCameraMock) -> None:
        assert mock.answer(p.encode_command(number, 5), ME) is None

    scenario(check)


def test_several_registers_in_one_command_go_as_far_as_they_can() -> None:
    def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        words = p.encode_words(Feature.WIDTH, 32, Feature.HEIGHT, 41, Feature.OFFSET_X, 1)
        answer = ask(mock, p.Command.WRITEREG, words)
        assert (answer.status, answer.payload) == (p.Status.INVALID_PARAMETER, b"\0\0\0\1")
        addresses = p.encode_words(Feature.WIDTH, Feature.HEIGHT, 0xB000, Feature.WIDTH)
        answer = ask(mock, p.Command.READREG, addresses)
        assert answer.status == p.Status.INVALID_ADDRESS
        assert p.decode_words(answer.payload) == (32, 40)
        assert read(mock, Feature.OFFSET_X) == 0

    scenario(check)


def test_memory_is_written_and_read_and_ends_with_power() -> None:
    async def check(mock: GigeCameraMock) -> None:
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        name = b"north".ljust(16, b"\0")
        user_name = p.USER_NAME.address
        answer = ask(mock, p.Command.WRITEMEM, p.encode_words(user_name) + name)
        assert (answer.status, answer.payload) == (p.Status.SUCCESS, b"\0\0\0\x10")
        answer = ask(mock, p.Command.READMEM, p.encode_readmem(user_name, 16))
        assert answer.payload == p.encode_words(user_name) + name
        mock.faults.set(Fault(device="camera", kind="reboot", value=0.01))
        while mock.faults.active:
            await asyncio.sleep(0.01)
        assert read(mock, user_name) == 0
        assert read(mock, p.Register.CONTROL_PRIVILEGE) == 0

    scenario(check)


@pytest.mark.parametrize("address", ["127.0.0.1", "127.255.255.255", "255.255.255.255"])
def test_discovery_is_heard_on_the_loopback_interface_alone(address: str) -> None:
    async def check(mock: GigeCameraMock) -> None:
        assert mock._control is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            # Whatever is sent to, no other interface is reached.
            client.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
            client.bind(("127.0.0.1", 0))
            client.setblocking(False)
            client.sendto(p.encode_command(p.Command.DISCOVERY, 1), (address, mock._control.port))
            answer = p.decode_answer(await received(client))
        assert (answer.status, len(answer.payload)) == (p.Status.SUCCESS, p.DISCOVERY_BYTES)

    scenario(check)


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(
    packets=st.lists(
        st.binary(max_size=40)
        | st.builds(
            p.encode_command,
            st.sampled_from([*p.Command, 0x99, 0xFFFE, 0xFFFF]),
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
        assert mock._control is not None
        second = camera_mock(port=mock._control.port)
        with pytest.raises(OSError, match="ddress already in use"):
            await second.start()
        await second.stop()

    scenario(check)


def test_a_camera_with_mono8_only_has_no_other_format_and_describes_none() -> None:
    def check(mock: GigeCameraMock) -> None:
        assert write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL) == p.Status.SUCCESS
        assert read(mock, Feature.PIXEL_FORMAT) == p.PIXEL_FORMATS["Mono8"].code
        mono16 = p.PIXEL_FORMATS["Mono16"].code
        assert write(mock, Feature.PIXEL_FORMAT, mono16) == p.Status.INVALID_PARAMETER

    scenario(check, mono8_only=True)


def test_the_last_programs_region_can_be_made_the_whole_sensor() -> None:
    def check(mock: GigeCameraMock) -> None:
        assert write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL) == p.Status.SUCCESS
        assert (read(mock, Feature.WIDTH), read(mock, Feature.OFFSET_X)) == (32, 8)
        assert write(mock, Feature.OFFSET_X, 0) == p.Status.SUCCESS
        assert write(mock, Feature.WIDTH, 40) == p.Status.SUCCESS

    scenario(check, offset_at_start_px=8)
