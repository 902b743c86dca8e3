"""Modbus frames beside pymodbus's own framer."""

from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer.rtu import FramerRTU

from fitctl.drivers.modbus import crc16, rtu_frame, take_rtu_answer

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


@given(st.binary(max_size=300))
def test_the_check_is_the_one_that_pymodbus_computes(data):
    assert int.from_bytes(crc16(data), "big") == FramerRTU.compute_CRC(data)


@given(
    st.integers(1, 247),
    ANSWERS,
    st.binary(max_size=8).map(lambda noise: noise.replace(b"\x07", b"")),
)
def test_an_answer_is_found_after_noise_and_whole_only(unit, pdu, noise):
    framed = rtu_frame(unit, pdu)
    pending = bytearray()
    for byte in framed[:-1]:
        pending.append(byte)
        assert take_rtu_answer(pending, unit) is None
    pending.append(framed[-1])
    assert take_rtu_answer(pending, unit) == pdu
    assert not pending
    assert take_rtu_answer(bytearray(bytes(b for b in noise if b != unit) + framed), unit) == pdu


@given(st.binary(max_size=300), st.integers(0, 255))
def test_no_noise_is_an_answer_without_its_check(noise, unit):
    pending = bytearray(noise)
    answer = take_rtu_answer(pending, unit)
    if answer is not None:
        assert rtu_frame(unit, answer) in noise
