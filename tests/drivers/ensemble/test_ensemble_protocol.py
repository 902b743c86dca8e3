import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.ensemble.protocol import (
    AxisFault,
    AxisStatus,
    decimals,
    fault_text,
    format_bits,
    parse_bits,
    parse_number,
)


def test_a_status_word_as_a_real_controller_has_sent_it():
    bits = parse_bits("-1791485433")
    assert bits & AxisStatus.ENABLED
    assert bits & AxisStatus.EMERGENCY_STOP
    assert not bits & AxisStatus.MOVING


@given(st.integers(0, 0xFFFF_FFFF))
def test_status_words_go_out_signed_and_come_back(bits):
    text = format_bits(bits)
    assert -(1 << 31) <= int(text) < 1 << 31
    assert parse_bits(text) == parse_bits(str(bits)) == bits


@given(st.text(max_size=20))
def test_any_text_is_a_number_or_refused(text):
    for parse in (parse_bits, parse_number):
        try:
            value = parse(text)
        except ValueError:
            continue
        assert math.isfinite(value)


@pytest.mark.parametrize("text", ["", "nan", "inf", "1.5", "4294967296", "-2147483649", "0x1"])
def test_what_is_no_status_word_is_refused(text):
    with pytest.raises(ValueError, match=r".+"):
        parse_bits(text)


def test_faults_are_said_by_name_and_unknown_bits_in_hex():
    assert fault_text(0) == ""
    assert fault_text(AxisFault.POSITION_ERROR | AxisFault.AMPLIFIER) == "position error, amplifier"
    assert fault_text(1 << 30) == "0x40000000"


@given(st.floats(1e-3, 1e7), st.floats(-1e3, 1e3))
def test_numbers_are_sent_to_a_hundredth_of_a_count(counts_per_unit, units):
    sent = float(f"{units:.{decimals(counts_per_unit)}f}")
    assert abs(sent - units) * counts_per_unit <= 0.01
