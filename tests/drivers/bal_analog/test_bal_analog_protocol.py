import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.bal_analog.protocol import (
    counts_to_volts,
    lines,
    signed,
    unwrap,
    velocity_to_counts,
    word_of,
)


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
