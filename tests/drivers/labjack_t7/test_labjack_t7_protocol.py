import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.labjack_t7 import protocol
from fitctl.drivers.labjack_t7.protocol import Register

WORDS = st.integers(0, 0xFFFF)
FLOAT = Register(0, "FLOAT32")


@pytest.mark.parametrize(
    ("kind", "value", "registers"),
    [  # LabJack's own test registers, TEST_...: what each type reads by default
        ("UINT16", 17, [0x0011]),
        ("UINT32", 1122867, [0x0011, 0x2233]),
        ("FLOAT32", -9999.0, [0xC61C, 0x3C00]),
    ],
)
def test_values_are_in_registers_as_labjacks_map_says(kind, value, registers):
    register = Register(55100, kind)
    assert protocol.encode(register, value) == registers
    assert protocol.decode(register, registers) == value


def test_ain0_to_ain3_are_at_0_2_4_and_6():
    assert [protocol.ain(number).address for number in range(4)] == [0, 2, 4, 6]


@given(st.lists(st.floats(width=32), max_size=14))
def test_any_voltages_come_back(volts):
    registers = [word for value in volts for word in protocol.encode(FLOAT, value)]
    for value, got in zip(volts, protocol.decode_inputs(registers), strict=True):
        assert got == value or (math.isnan(got) and math.isnan(value))


@given(st.lists(WORDS, max_size=20))
def test_any_registers_are_voltages_or_an_error(registers):
    if len(registers) % 2:
        with pytest.raises(ValueError, match="2 registers each"):
            protocol.decode_inputs(registers)
    else:
        assert len(protocol.decode_inputs(registers)) == len(registers) // 2


@given(st.integers(0, 2**32 - 1))
def test_any_serial_number_comes_back(number):
    registers = protocol.encode(protocol.SERIAL_NUMBER, number)
    assert protocol.decode(protocol.SERIAL_NUMBER, registers) == number


@pytest.mark.parametrize(
    ("kind", "value"), [("UINT16", 65536), ("UINT32", -1), ("UINT16", math.inf), ("FLOAT32", 1e39)]
)
def test_what_a_type_cannot_be_is_an_error(kind, value):
    with pytest.raises(ValueError, match=f"no {kind}"):
        protocol.encode(Register(0, kind), value)


def test_half_a_value_is_an_error():
    with pytest.raises(ValueError, match="2 registers, got 1"):
        protocol.decode(FLOAT, [0])


def test_a_larger_resolution_index_has_less_noise_and_no_shorter_time():
    noises, times = zip(*(protocol.CONVERTER[index] for index in range(1, 13)), strict=True)
    assert list(noises) == sorted(noises, reverse=True)
    assert list(times) == sorted(times)
    assert protocol.converter(0, pro=False) == protocol.CONVERTER[8]
    assert protocol.converter(0, pro=True) == protocol.CONVERTER[9]
