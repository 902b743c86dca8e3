from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.mdt693.protocol import (
    Answer,
    format_three_volts,
    format_volts,
    format_volts_a,
    is_complete,
    is_frame_only,
    parse_answer,
    parse_identity,
    parse_limit_switch,
    parse_three_volts,
    parse_volts,
)

# What devices sent: command, bytes, and what they meant.
ECHO = {"refused": False, "echoed": True}
PLAIN = {"refused": False, "echoed": False}
TRANSCRIPT = [
    ("vlimit?", b"vlimit?\r*[ 100]\r*", Answer("[ 100]", **ECHO)),
    ("xvoltage?", b"xvoltage?\r*[  24.8]\r*", Answer("[  24.8]", **ECHO)),
    ("serial?", b"serial?\r140421-07\r*", Answer("140421-07", **ECHO)),
    ("xvoltage?", b"XVOLTAGE?\r\n[  24.8]\r\n> ", Answer("[  24.8]", **ECHO)),
    ("xvoltage?", b" xvoltage?\r[ 24.8]\r>", Answer("[ 24.8]", **ECHO)),
    ("xvoltage?", b"[ 24.80]\r>", Answer("[ 24.80]", **PLAIN)),
    ("id?", b"id?\r*\r\r\rModel MDT693B\rName:\r\r*", Answer("Model MDT693B\rName:", **ECHO)),
    ("I", b"\r\r\rModel MDT693A\r\r*", Answer("Model MDT693A", **PLAIN)),
    ("xyzvoltage?", b"CMD_NOT_DEFINED>", Answer("", refused=True, echoed=False)),
    ("xyzvoltage?", b"xyzvoltage?\rCMD_NOT_DEFINED\r> ", Answer("", refused=True, echoed=True)),
    ("id?", b"id?\r!", Answer("", refused=True, echoed=True)),
    ("", b"\n\r!", Answer("", refused=True, echoed=True)),
    ("XR?", b"*[   0.9]\r", Answer("[   0.9]", **PLAIN)),
    ("XR?", b"xr?\r*[   0.9]\r", Answer("[   0.9]", **ECHO)),
    ("%", b"*[ 150]\r", Answer("[ 150]", **PLAIN)),
    ("XV0", b"xv0\r!\0", Answer("", refused=True, echoed=True)),
    ("serial?", b"150226175403\r>", Answer("150226175403", **PLAIN)),
    ("xmax?", b"150.50\r>", Answer("150.50", **PLAIN)),
    ("xyzvoltage?", b"[  0.24,  0.21,  0.22]\r>", Answer("[  0.24,  0.21,  0.22]", **PLAIN)),
    ("XV10", b"*", Answer("", **PLAIN)),
]


@pytest.mark.parametrize(("command", "data", "answer"), TRANSCRIPT, ids=str)
def test_every_recorded_variant_is_understood(command, data, answer):
    assert parse_answer(command, data) == answer


@pytest.mark.parametrize(("command", "data", "_"), TRANSCRIPT[:-1], ids=str)
def test_an_answer_is_complete_at_its_last_byte_and_not_before(command, data, _):
    assert is_complete(command, data)
    # ``> `` may be cut to ``>``; ``MDT693B\r\r*`` has no shorter end; a star after a value that came
    # with one, and a NUL, say nothing
    end = len(data.rstrip(b" \0")) - data.endswith(b"]\r*")
    assert not any(is_complete(command, data[:n]) for n in range(end))


def test_what_follows_an_answer_that_was_complete_without_it_does_no_harm():
    assert parse_answer("XR?", b"*xr?\r*[   0.9]\r") == Answer("[   0.9]", **ECHO)
    assert parse_answer("XR?", b"\0*[   0.9]\r") == Answer("[   0.9]", **PLAIN)
    assert is_frame_only("XL?", b"*xl?\r\n\0> *")
    assert not is_frame_only("XL?", b"*0")


def test_an_answer_without_a_prompt_is_understood_too():
    assert parse_answer("xmax?", b"xmax?\r*100.5") == Answer("100.5", **ECHO)
    assert parse_answer("XL?", b"*0\0") == Answer("0", **PLAIN)
    assert not is_complete("xmax?", b"xmax?\r*100.5")


@pytest.mark.parametrize("noise", [b"", b"\r\r", b"\xfe[ 1\x00?\r", b"[ 1\x00]\r>"])
def test_noise_is_no_answer(noise):
    with pytest.raises(ValueError, match=r"neither|control|decode"):
        parse_answer("xvoltage?", noise)


@given(
    st.sampled_from(["", "%", "I", "id?", "XL?", "xvoltage?", "xyzvoltage?"]),
    st.binary(max_size=60),
)
def test_any_bytes_are_an_answer_or_a_value_error(command, data):
    is_complete(command, data)
    is_frame_only(command, data)
    for parse in (parse_volts, parse_three_volts, parse_limit_switch, parse_identity):
        with suppress(ValueError):
            parse(parse_answer(command, data).body)


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20))
def test_a_recorded_answer_is_read_after_whatever_was_asked(command):
    for echo in (b"", command.encode() + b"\r"):
        answer = parse_answer(command, echo + b"*[  24.8]\r*")
        assert parse_volts(answer.body) == 24.8
        assert answer.echoed is bool(echo)


@given(st.floats(-1, 151), st.sampled_from([1, 2]))
def test_measured_volts_come_back_within_half_their_resolution(volts, decimals):
    told = parse_volts(format_volts(volts, decimals))
    assert abs(told - volts) <= 0.501 * 10**-decimals
    assert abs(parse_volts(format_volts_a(volts)) - volts) <= 0.0501


@given(st.lists(st.floats(0, 151), min_size=3, max_size=3))
def test_three_measured_volts_come_back(volts):
    assert parse_three_volts(format_three_volts(volts, 2)) == pytest.approx(volts, abs=0.00501)


@pytest.mark.parametrize(
    "body", ["", "[ 24.8", "24.8]", "24,8", "24.8 V", "[]", "nan", "1e3", "[1 2]"]
)
def test_half_a_voltage_is_none(body):
    with pytest.raises(ValueError, match="is not a voltage"):
        parse_volts(body)


@pytest.mark.parametrize("body", ["1, 2", "[1, 2, 3", "1, 2, 3]", "1, 2, 3, 4", "[1], [2], [3]"])
def test_three_voltages_are_three(body):
    with pytest.raises(ValueError, match="three voltages"):
        parse_three_volts(body)


@pytest.mark.parametrize(
    ("body", "volts"),
    [("[ 100]", 100), ("[  75]", 75), ("150", 150), ("0", 75), ("1", 100), ("2", 150)],
)
def test_the_limit_switch_is_read_in_volts_or_as_a_position(body, volts):
    assert parse_limit_switch(body) == volts


@pytest.mark.parametrize("body", ["3", "[ 2]", "[ 120]", "100.5", "", "-1", "one"])
def test_the_limit_switch_has_no_other_position(body):
    with pytest.raises(ValueError, match="position"):
        parse_limit_switch(body)


def test_identity_names_an_mdt():
    body = "Model MDT693B Piezo Control Module\rFirmware Version: 1.05\rVoltage Range: 0 to 150 V"
    assert parse_identity(body) == ("MDT693B", "1.05")
    with pytest.raises(ValueError, match="no MDT693"):
        parse_identity("OK")
