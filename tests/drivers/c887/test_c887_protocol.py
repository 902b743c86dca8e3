"""GCS 2.0 answers: what is read back as it was made, and what is no answer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.c887 import protocol
from fitctl.drivers.c887.protocol import AXES

numbers = st.floats(-1000, 1000)
PARSERS = [
    protocol.parse_float,
    protocol.parse_error,
    protocol.parse_bits,
    protocol.parse_ready,
    protocol.parse_identity,
    protocol.one_line,
    lambda answer: protocol.parse_numbers(answer, AXES),
    lambda answer: protocol.parse_flags(answer, AXES),
    lambda answer: protocol.parse_values(answer, ["X"]),
]


@given(st.lists(numbers, min_size=6, max_size=6))
def test_numbers_of_all_axes_are_read_back(values):
    answer = protocol.answer_values(zip(AXES, values, strict=True))
    assert protocol.is_complete(answer)
    assert protocol.parse_numbers(answer, AXES) == pytest.approx(values, abs=1e-7)


@given(st.lists(st.booleans(), min_size=6, max_size=6), st.integers(1, 40))
def test_an_answer_is_complete_only_at_its_end(flags, cut):
    answer = protocol.answer_values(zip(AXES, flags, strict=True))
    assert protocol.parse_flags(answer, AXES) == flags
    cut = min(cut, len(answer) - 1)
    assert not protocol.is_complete(answer[:cut])


@given(st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(answer):
    for parse in PARSERS:
        try:
            parse(answer)
        except ValueError:
            continue


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"X=1.0 \n",
        b"X=1.0\nY=2.0\n",
        b"X=1.0 \nY=2.0\n",
        b"Y=1.0\n",
        b"X 1.0\n",
        b"X=\n",
        b"X=nan\n",
        b"X=inf\n",
        b"X=1,0\n",
        b"X=\xff\n",
    ],
)
def test_what_is_no_number_of_x(answer):
    with pytest.raises(ValueError, match=r"X|number|float|answer|decode"):
        protocol.parse_numbers(answer, ["X"])


def test_answers_as_other_firmware_may_write_them():
    assert protocol.parse_numbers(b"X = 1.0e-3 \nY=-2\n", ["X", "Y"]) == [0.001, -2.0]
    assert protocol.parse_bits(b"0x3F\n") == protocol.parse_bits(b"3f\n") == 63
    name = b"(c)2011-2019 Physik Instrumente (PI) GmbH & Co. KG, C-887.52, 119012345, 2.6.1.4\n"
    assert protocol.parse_identity(name)[1:] == ("C-887.52", "119012345", "2.6.1.4")


def test_commands():
    assert protocol.line("VLS", 0.5) == b"VLS 0.500000\n"
    assert protocol.with_values("MOV", [("X", 1.0), ("W", -0.25)]) == (
        b"MOV X 1.000000 W -0.250000\n"
    )
    assert protocol.error_text(7) == "error 7, the pose is out of reach"
    assert protocol.error_text(4711) == "error 4711"
