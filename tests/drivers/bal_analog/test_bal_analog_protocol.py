import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.bal_analog.protocol import (
    counts_to_volts,
    decode_registers,
    encode_exchange,
    encode_read,
    lines,
    signed,
    unwrap,
    velocity_to_counts,
    word_of,
)
from fitctl.drivers.modbus import (
    READ_HOLDING_REGISTERS,
    Message,
    decode_identity,
    encode_identify,
    frame,
    pop_message,
)


def test_one_period_on_the_wire():
    request = frame(0x1234, 1, encode_exchange(16, 0, [0x0001, 0xFFFF, 0x0003]))
    assert request.hex(" ") == (
        "12 34 00 00 00 11 01"  # 17 bytes to unit 1
        " 17 00 10 00 03 00 00 00 03 06"  # read three from 16, write three from 0
        " 00 01 ff ff 00 03"
    )
    answer = bytearray.fromhex("12 34 00 00 00 09 01 17 06 ff fe 00 05 00 02")
    message = pop_message(answer)
    assert message == Message(0x1234, 1, bytes.fromhex("17 06 ff fe 00 05 00 02"))
    assert decode_registers(message.pdu) == [0xFFFE, 5, 2]
    assert not answer


def test_a_question_without_effect():
    assert encode_read(16).hex(" ") == "03 00 10 00 03"
    assert decode_registers(bytes.fromhex("03 06 0001 0002 0003"), READ_HOLDING_REGISTERS) == [
        1,
        2,
        3,
    ]
    assert encode_identify().hex(" ") == "2b 0e 01 00"


def test_who_answers():
    answer = bytes.fromhex("2b 0e 01 81 00 00 03") + b"\x00\x04Acme\x01\x02IO\x02\x031.2"
    assert decode_identity(answer) == ["Acme", "IO", "1.2"]
    assert decode_identity(b"\xab\x01") == decode_identity(b"") == ["", "", ""]


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=1, max_size=253))
def test_frames_come_out_as_they_went_in(transaction, unit, pdu):
    pending = bytearray(frame(transaction, unit, pdu) * 2)
    assert pop_message(pending) == pop_message(pending) == Message(transaction, unit, pdu)
    assert pop_message(pending) is None


@given(st.binary(max_size=400))
def test_any_bytes_are_messages_an_error_or_the_start_of_one(data):
    pending = bytearray(data)
    try:
        while (message := pop_message(pending)) is not None:
            decode_identity(message.pdu)
            assert len(decode_registers(message.pdu)) == 3
    except ValueError:
        pass


@given(st.floats(-1e6, 1e6), st.floats(0.1, 100) | st.floats(-100, -0.1))
def test_a_velocity_comes_out_of_the_output_as_it_went_in_or_held(velocity, rad_s_per_v):
    register = velocity_to_counts(velocity, rad_s_per_v, 10.0, 32767)
    volts = counts_to_volts(register, 10.0, 32767)
    held = max(-10.0, min(10.0, velocity / rad_s_per_v))
    assert volts == pytest.approx(held, abs=10 / 32767)


def test_a_velocity_command_is_twos_complement():
    assert velocity_to_counts(60.0, 6.0, 10.0, 32767) == 32767
    assert velocity_to_counts(-60.0, 6.0, 10.0, 32767) == 32769
    assert velocity_to_counts(6.0, -6.0, 10.0, 27648) == 0x10000 - 2765
    assert counts_to_volts(0x8000, 10.0, 32767) == -10.0
    for wrong in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="finite"):
            velocity_to_counts(wrong, 6.0, 10.0, 32767)


@given(st.integers(-(10**9), 10**9), st.integers(-32767, 32767))
def test_a_counter_is_counted_on_across_its_wrap(before, step):
    assert unwrap((before + step) & 0xFFFF, before) == before + step


@given(st.booleans(), st.booleans(), st.sampled_from(["high", "low"]))
def test_lines_are_read_as_they_are_set(az, el, level):
    word = word_of(az, el, level)
    assert 0 <= word <= 3
    # What else is wired to the same word does not matter.
    assert lines(word | 0xFF00, level) == lines(word & 3, level) == (az, el)


@given(st.integers(0, 0xFFFF))
def test_registers_are_signed_as_struct_has_it(register):
    assert signed(register) == struct.unpack(">h", struct.pack(">H", register))[0]
