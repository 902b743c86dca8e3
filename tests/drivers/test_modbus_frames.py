"""What the drivers make of bytes from a station, beside frames that the mocks build without pymodbus."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu.register_message import (
    ReadWriteMultipleRegistersRequest,
    WriteMultipleRegistersRequest,
)

from fitctl.drivers.modbus import (
    RTU,
    TCP,
    Answer,
    decode_exception,
    decode_identity,
    decode_registers,
    encode_identify,
    encode_pdu,
    pop_answer,
    pop_rtu_answer,
)
from fitctl.mocks.modbus import rtu, tcp

UNITS = st.integers(0, 255)
RTU_UNITS = st.integers(1, 247)
PDUS = st.binary(min_size=2, max_size=253)
ANSWERS = st.one_of(
    st.binary(min_size=4, max_size=4).map(lambda rest: b"\x10" + rest),
    st.binary(max_size=120).map(lambda data: bytes([3, len(data)]) + data),
    st.integers(0, 255).map(lambda code: bytes([0x90, code])),
    st.lists(st.binary(max_size=30), max_size=3).map(
        lambda texts: (
            bytes([43, 14, 1, 1, 0, 0, len(texts)])
            + b"".join(bytes([n, len(text)]) + text for n, text in enumerate(texts))
        )
    ),
)


# ---------------------------------------------------------------- requests


def test_a_write_on_both_wires():
    write = WriteMultipleRegistersRequest(
        address=0x20, registers=[1, 0x8000, 0xFFFF], dev_id=5, transaction_id=0x1234
    )
    pdu = bytes.fromhex("10 0020 0003 06 0001 8000 ffff")
    assert encode_pdu(write) == pdu
    assert TCP.buildFrame(write) == bytes.fromhex("1234 0000 000d 05") + pdu
    assert RTU.buildFrame(write) == rtu.frame(5, pdu)


def test_one_servo_period_on_the_wire():
    exchange = ReadWriteMultipleRegistersRequest(
        read_address=16,
        read_count=3,
        write_address=0,
        write_registers=[0x0001, 0xFFFF, 0x0003],
        transaction_id=0x1234,
    )
    assert TCP.buildFrame(exchange).hex(" ") == (
        "12 34 00 00 00 11 01"  # 17 bytes to unit 1
        " 17 00 10 00 03 00 00 00 03 06"  # read three from 16, write three from 0
        " 00 01 ff ff 00 03"
    )
    answer = pop_answer(bytearray.fromhex("12 34 00 00 00 09 01 17 06 ff fe 00 05 00 02"))
    assert answer == Answer(0x1234, 1, bytes.fromhex("17 06 ff fe 00 05 00 02"))
    assert decode_registers(answer.pdu, 23, 3) == [0xFFFE, 5, 2]


# ---------------------------------------------------------------- frames over TCP


@given(st.lists(st.builds(Answer, st.integers(0, 65535), UNITS, PDUS), max_size=4), st.data())
def test_tcp_answers_come_out_as_the_mock_framed_them_however_the_stream_is_cut(answers, data):
    stream = b"".join(tcp.frame(*answer) for answer in answers)
    cut = data.draw(st.integers(0, len(stream)))
    pending, popped = bytearray(), []
    for piece in (stream[:cut], stream[cut:]):
        pending += piece
        while (answer := pop_answer(pending)) is not None:
            popped.append(answer)
    assert popped == answers
    assert not pending


@pytest.mark.parametrize(
    "header",
    [
        pytest.param("00 01 00 01 00 06 01", id="another protocol"),
        pytest.param("00 01 00 00 00 00", id="no unit"),
        pytest.param("00 01 00 00 00 01", id="no PDU"),
        pytest.param("00 01 00 00 00 02 01 03 ff", id="a PDU of one byte"),
        pytest.param("00 01 00 00 00 ff", id="too long"),
    ],
)
def test_a_header_that_no_answer_has_is_an_error_at_once_instead_of_a_wait_for_more(header):
    with pytest.raises(ValueError, match=r"protocol \d, length \d+"):
        pop_answer(bytearray.fromhex(header))


@given(st.binary(max_size=600))
def test_any_bytes_are_answers_an_error_or_the_start_of_one(noise):
    pending = bytearray(noise)
    try:
        while (answer := pop_answer(pending)) is not None:
            assert 2 <= len(answer.pdu) <= 253
    except ValueError:
        return
    assert len(pending) < 260


# ---------------------------------------------------------------- frames over RTU


@given(RTU_UNITS, ANSWERS, st.binary(max_size=8))
def test_an_answer_is_found_after_noise_and_whole_only(unit, pdu, noise):
    framed = rtu.frame(unit, pdu)
    pending = bytearray()
    for byte in framed[:-1]:
        pending.append(byte)
        assert pop_rtu_answer(pending, unit) is None
    pending.append(framed[-1])
    assert pop_rtu_answer(pending, unit) == pdu
    assert not pending
    assert pop_rtu_answer(bytearray(bytes(b for b in noise if b != unit) + framed), unit) == pdu


@given(RTU_UNITS, ANSWERS, ANSWERS)
def test_an_answer_behind_another_one_in_the_same_read_is_not_lost(unit, late, pdu):
    pending = bytearray(rtu.frame(unit, late) + rtu.frame(unit, pdu))
    assert pop_rtu_answer(pending, unit) == late
    assert pop_rtu_answer(pending, unit) == pdu
    assert not pending


def test_an_answer_behind_one_with_a_turned_bit_is_not_lost():
    spoilt = bytearray(rtu.frame(1, bytes.fromhex("10 00 00 00 03")))
    spoilt[3] ^= 4
    pdu = bytes.fromhex("03 06 00 01 00 02 00 03")
    assert pop_rtu_answer(spoilt + rtu.frame(1, pdu), 1) == pdu


@pytest.mark.parametrize("before", ["", "01", "01 55", "01 03", "01 2b 0d"])
def test_an_answer_of_another_unit_is_none_of_ours_whatever_comes_before_it(before):
    foreign = rtu.frame(100, bytes.fromhex("10 00 00 00 03"))
    assert pop_rtu_answer(bytearray.fromhex(before) + foreign, 1) is None


@given(st.binary(max_size=300), UNITS)
def test_no_noise_is_an_answer_without_its_check(noise, unit):
    pending = bytearray(noise)
    answer = pop_rtu_answer(pending, unit)
    if answer is not None:
        assert rtu.frame(unit, answer) in noise


@given(st.integers(0, 255), st.binary(max_size=40), st.binary(max_size=4))
def test_no_function_code_with_a_right_check_leads_to_anything_but_an_answer_or_none(
    code, body, rest
):
    pending = bytearray(rtu.frame(1, bytes([code]) + body) + rest)
    answer = pop_rtu_answer(pending, 1)
    assert answer is None or isinstance(answer, bytes)


# ---------------------------------------------------------------- PDUs


@given(st.sampled_from([3, 23]), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=10))
def test_registers_are_those_of_the_right_function_and_number_only(function_code, registers):
    data = b"".join(register.to_bytes(2, "big") for register in registers)
    pdu = bytes([function_code, len(data)]) + data
    assert decode_registers(pdu, function_code, len(registers)) == registers
    for wrong in (
        (pdu, 26 - function_code, len(registers)),
        (pdu, function_code, len(registers) + 1),
        (pdu + b"\0", function_code, len(registers)),
        (pdu[:-1], function_code, len(registers)),
        (bytes([function_code, len(data) + 1]) + data + b"\0", function_code, len(registers)),
    ):
        with pytest.raises(ValueError, match="bytes: "):
            decode_registers(*wrong)


def test_a_refusal_is_one_of_its_own_function_and_of_two_bytes():
    assert decode_exception(b"\x90\x04", 16) == 4
    for other in (b"\x83\x04", b"\x90", b"\x90\x04\x00", b"\x10\x04", b"\x80\x04", b"\x03\x00"):
        assert decode_exception(other, 16) is None


def test_who_answers():
    assert encode_pdu(encode_identify()).hex(" ") == "2b 0e 01 00"
    head = bytes.fromhex("2b 0e 01 81 00 00 03")
    assert decode_identity(head + b"\x00\x04Acme\x01\x02IO\x02\x031.2") == ["Acme", "IO", "1.2"]
    assert decode_identity(head + b"\x01\x02IO") == ["", "IO", ""]
    assert decode_identity(head + b"\x00\x01A\x00\x01B\x02\x011") == ["B", "", "1"]
    for other in (b"\xab\x01", b"", b"\x2b", b"\x2b\x0d\x01\x81\x00\x00\x00", b"\x03\x02\x00\x07"):
        assert decode_identity(other) == ["", "", ""]


@given(st.binary(max_size=253) | st.binary(max_size=60).map(lambda rest: b"\x2b\x0e" + rest))
def test_any_pdu_is_decoded_or_rejected(pdu):
    assert len(decode_identity(pdu)) == 3
    decode_exception(pdu, 16)
    for function_code in (3, 23):
        try:
            assert len(decode_registers(pdu, function_code, 3)) == 3
        except ValueError:
            continue
