from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.gige import protocol as p
from fitctl.drivers.gige.discovery import decode_found

MONO16 = p.PIXEL_FORMATS["Mono16"]
u16 = st.integers(0, 0xFFFF)
u24 = st.integers(0, 0xFFFFFF)
u32 = st.integers(0, 0xFFFFFFFF)


def test_reading_the_control_privilege_on_the_wire() -> None:
    command = p.encode_command(p.Command.READREG, 7, p.encode_words(p.Register.CONTROL_PRIVILEGE))
    assert command == bytes.fromhex("42 01 0080 0004 0007  00000a00")
    answer = bytes.fromhex("0000 0081 0004 0007  00000002")
    assert p.decode_answer(answer) == p.AnswerPacket(0, 0x81, 7, b"\0\0\0\2")


def test_a_discovery_on_the_wire() -> None:
    assert p.encode_command(p.Command.DISCOVERY, 1) == bytes.fromhex("42 01 0002 0000 0001")


def test_a_refusal_on_the_wire() -> None:
    refusal = p.encode_answer(p.Command.WRITEREG + 1, 9, status=p.Status.ACCESS_DENIED)
    assert refusal == bytes.fromhex("8006 0083 0000 0009")
    assert p.is_error(p.decode_answer(refusal).status)
    assert p.status_name(0x8006) == "0x8006 ACCESS_DENIED"
    assert p.status_name(0x80FE) == "0x80FE"


def test_a_leader_on_the_wire() -> None:
    header = p.encode_stream_header(p.StreamHeader(0, 1, p.FORMAT_LEADER, 0))
    leader = header + p.encode_leader(p.Leader(0x1122334455667788, MONO16.code, 40, 30))
    assert leader == bytes.fromhex(
        "0000 0001 01000000"
        "0000 0001 1122334455667788 01100007 00000028 0000001e 00000000 00000000 0000 0000"
    )


def test_a_resend_request_on_the_wire() -> None:
    payload = p.encode_resend(p.Resend(0, 0x1234, 2, 5))
    assert payload == bytes.fromhex("0000 1234 00000002 00000005")


@given(command=u16, request=st.integers(1, 0xFFFF), payload=st.binary(max_size=540))
def test_commands_come_back_as_they_were_sent(command: int, request: int, payload: bytes) -> None:
    packet = p.encode_command(command, request, payload)
    assert p.decode_command(packet) == p.CommandPacket(1, command, request, payload)


@given(answer=st.builds(p.AnswerPacket, u16, u16, u16, st.binary(max_size=540)))
def test_answers_come_back_as_they_were_sent(answer: p.AnswerPacket) -> None:
    packet = p.encode_answer(answer.command, answer.request_id, answer.payload, answer.status)
    assert p.decode_answer(packet) == answer


@given(request=st.builds(p.Resend, u16, u16, u24, u24))
def test_resend_requests_come_back_as_they_were_sent(request: p.Resend) -> None:
    assert p.decode_resend(p.encode_resend(request)) == request


@given(header=st.builds(p.StreamHeader, u16, u16, st.integers(0, 255), u24))
def test_stream_headers_come_back_as_they_were_sent(header: p.StreamHeader) -> None:
    assert p.decode_stream_header(p.encode_stream_header(header)) == header


@given(leader=st.builds(p.Leader, st.integers(0, 2**64 - 1), u32, u32, u32, u32, u32))
def test_leaders_come_back_as_they_were_sent(leader: p.Leader) -> None:
    assert p.decode_leader(p.encode_leader(leader)) == leader


@given(words=st.lists(u32, max_size=100))
def test_words_come_back_as_they_were_sent(words: list[int]) -> None:
    assert p.decode_words(p.encode_words(*words)) == tuple(words)


@given(
    location=st.builds(
        p.XmlLocation, st.from_regex(r"[A-Za-z0-9_]+\.(xml|zip)", fullmatch=True), u32, u32
    )
)
def test_xml_urls_come_back_as_they_were_written(location: p.XmlLocation) -> None:
    assert p.decode_xml_url(p.encode_xml_url(location)) == location


@pytest.mark.parametrize(
    "url",
    ["local:///c.zip;1000;2A", "Local:c.zip;1000;2a", "LOCAL:c.zip;1000;2A?SchemaVersion=1.1.0"],
)
def test_every_way_of_writing_an_xml_url_is_understood(url: str) -> None:
    assert p.decode_xml_url(url) == p.XmlLocation("c.zip", 0x1000, 0x2A)


@given(noise=st.binary(max_size=64))
def test_noise_is_read_or_refused_but_never_crashes(noise: bytes) -> None:
    for decode in (
        p.decode_command,
        p.decode_answer,
        p.decode_words,
        p.decode_readmem,
        p.decode_resend,
        p.decode_forceip,
        p.decode_pending_s,
        p.decode_stream_header,
        p.decode_leader,
        decode_found,
        lambda data: p.decode_xml_url(data.decode("latin-1")),
    ):
        with contextlib.suppress(p.MalformedPacketError):
            decode(noise)


def test_block_ids_wrap_past_zero() -> None:
    assert p.next_block(0) == 1
    assert p.next_block(65535) == 1
    assert p.previous_block(1) == 65535
    assert p.previous_block(2) == 1
    assert p.blocks_between(65534, 2) == 3


@given(start=st.integers(1, 65535), steps=st.integers(0, 300))
def test_blocks_are_counted_as_they_are_numbered(start: int, steps: int) -> None:
    block = start
    for _ in range(steps):
        block = p.next_block(block)
    assert p.blocks_between(start, block) == steps
