import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer.rtu import FramerRTU

from fitctl.drivers.modbus_dac.protocol import rtu_silence_s
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.modbus import rtu
from fitctl.mocks.modbus.pdu import DataModel
from fitctl.mocks.modbus.tcp import Message, ModbusTcpServer, frame, pop_message

MESSAGES = st.builds(
    Message,
    st.integers(0, 65535),
    st.integers(0, 255),
    st.binary(min_size=1, max_size=253),
    protocol=st.just(0),
)
SERVER = ModbusTcpServer(
    DataModel(range(3), lambda _first, count: [7] * count, lambda *_: None, ()),
    Faults(WIRE_FAULTS),
    unit=1,
    unknown_unit="refuse",
)


def taken_from(pending):
    messages = []
    while (message := pop_message(pending)) is not None:
        messages.append(message)
    return messages


@given(st.lists(MESSAGES, max_size=5), st.data())
def test_tcp_messages_come_out_as_they_went_in_however_the_stream_is_cut(messages, data):
    stream = b"".join(frame(*message[:3]) for message in messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=4)))
    pending = bytearray()
    taken = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        pending += stream[begin:end]
        taken += taken_from(pending)
    assert taken == messages
    assert not pending


def test_a_message_of_another_protocol_is_thrown_away_and_the_next_is_served():
    foreign = bytes.fromhex("00 01 00 01 00 06 01 03 00 00 00 03")
    ours = frame(2, 1, bytes.fromhex("03 00 00 00 01"))
    answers = [SERVER.respond(message) for message in taken_from(bytearray(foreign + ours))]
    assert answers == [b"", frame(2, 1, bytes.fromhex("03 02 00 07"))]


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
def test_a_length_that_cannot_be_is_out_of_step(length):
    header = b"\0\1\0\0" + length.to_bytes(2, "big") + b"\1"
    with pytest.raises(ValueError, match="length"):
        pop_message(bytearray(header))


@given(st.binary(max_size=600))
def test_any_bytes_leave_less_than_a_message_waiting(noise):
    pending = bytearray(noise)
    try:
        for message in taken_from(pending):
            assert 1 <= len(message.pdu) <= 253
    except ValueError:
        return
    assert len(pending) < 260


def test_the_check_of_an_rtu_frame_is_the_standards():
    # The serial line guide's own example, then one that is printed everywhere.
    assert rtu.crc16(bytes([2, 7])).hex(" ") == "41 12"
    assert rtu.frame(1, bytes.fromhex("03 00 00 00 0a")).hex(" ") == "01 03 00 00 00 0a c5 cd"


@given(st.binary(max_size=254))
def test_another_implementation_finds_the_same_check(data):
    assert rtu.crc16(data) == FramerRTU.compute_CRC(data).to_bytes(2, "big")


@given(st.integers(0, 255), st.binary(min_size=1, max_size=253), st.data())
def test_an_rtu_frame_comes_back_and_a_turned_bit_is_seen(unit, pdu, data):
    framed = rtu.frame(unit, pdu)
    assert rtu.parse_frame(framed) == (unit, pdu)
    bit = data.draw(st.integers(0, 8 * len(framed) - 1))
    turned = bytearray(framed)
    turned[bit // 8] ^= 1 << bit % 8
    assert rtu.parse_frame(bytes(turned)) is None


@given(st.binary(max_size=300))
def test_any_bytes_are_a_frame_or_none(noise):
    parsed = rtu.parse_frame(noise)
    assert parsed is None or rtu.frame(*parsed) == noise


def test_the_silence_between_frames_is_three_and_a_half_characters_but_never_too_short():
    assert rtu_silence_s(9600) == pytest.approx(4.01e-3, rel=1e-3)
    assert rtu_silence_s(19200) == pytest.approx(2.005e-3, rel=1e-3)
    assert rtu_silence_s(115200) == 1.75e-3
