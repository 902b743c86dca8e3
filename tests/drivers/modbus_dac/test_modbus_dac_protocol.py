import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.modbus_dac.protocol import counts_max, decode_counts, encode_volts

BITS = st.integers(8, 16)
FULL_SCALE_V = st.sampled_from([5.0, 10.0, 10.24])


def test_the_ends_of_the_range_are_the_ends_of_the_counts():
    assert encode_volts([0.0, 5.0, 10.0], 10.0, 16) == [0, 32768, 65535]
    assert decode_counts([0, 65535, 0], 10.0, 16) == [0.0, 10.0, 0.0]


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3), FULL_SCALE_V, BITS)
def test_volts_come_back_within_half_a_count(fractions, full_scale_v, bits):
    volts = [fraction * full_scale_v for fraction in fractions]
    counts = encode_volts(volts, full_scale_v, bits)
    half_a_count_v = 0.5 * full_scale_v / counts_max(bits)
    for wanted, got in zip(volts, decode_counts(counts, full_scale_v, bits), strict=True):
        assert abs(wanted - got) <= half_a_count_v * (1 + 1e-6)


@given(BITS, st.data())
def test_every_count_survives_the_way_to_volts_and_back(bits, data):
    counts = data.draw(st.lists(st.integers(0, counts_max(bits)), min_size=3, max_size=3))
    assert encode_volts(decode_counts(counts, 10.0, bits), 10.0, bits) == counts


@pytest.mark.parametrize("bad_v", [-1e-9, math.nextafter(10.0, 11.0), math.nan, math.inf])
@pytest.mark.parametrize("channel", [1, 2, 3])
def test_volts_out_of_range_name_their_channel(channel, bad_v):
    volts = [5.0, 5.0, 5.0]
    volts[channel - 1] = bad_v
    with pytest.raises(ValueError, match=f"channel {channel} gives 0 to 10 V"):
        encode_volts(volts, 10.0, 16)


def test_two_voltages_or_two_registers_are_not_three():
    with pytest.raises(ValueError, match="3 channels, got 2"):
        encode_volts([1.0, 2.0], 10.0, 16)
    with pytest.raises(ValueError, match="3 channels, got 2"):
        decode_counts([1, 2], 10.0, 16)


def test_counts_beyond_the_resolution_name_their_channel():
    with pytest.raises(ValueError, match="channel 2 has 0 to 4095 counts, got 4096"):
        decode_counts([0, 4096, 0], 10.0, 12)
