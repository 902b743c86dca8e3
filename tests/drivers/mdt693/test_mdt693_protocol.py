import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.mdt693.protocol import (
    Answer,
    format_three_volts,
    format_volts,
    is_complete,
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
    ("XV10", b"*", Answer("", **PLAIN)),
]


@pytest.mark.parametrize(("command", "data", "answer"), TRANSCRIPT, ids=str)
def test_every_recorded_variant_is_understood(command, data, answer):
    assert parse_answer(command, data) == answer


@pytest.mark.parametrize(("command", "data", "_"), TRANSCRIPT[:-1], ids=str)
def test_an_answer_is_complete_at_its_last_byte_and_not_before(command, data, _):
    assert is_complete(command, data)
    # ``> `` may be cut to ``>``, and ``MDT693B\r\r*`` has no shorter end
    assert not any(is_complete(command, data[:n]) for n in range(len(data.rstrip())))


def test_an_answer_without_a_prompt_is_understood_too():
    assert parse_answer("xmax?", b"xmax?\r*100.5") == Answer("100.5", **ECHO)
    assert not is_complete("xmax?", b"xmax?\r*100.5")


@pytest.mark.parametrize("noise", [b"", b"\r\r", b"\xfe[ 1\x00?\r", b"[ 1\x00]\r>"])
def test_noise_is_no_answer(noise):
    with pytest.raises(ValueError, match=r"neither|control|decode"):
        parse_answer("xvoltage?", noise)


@given(st.binary(max_size=60))
def test_any_bytes_are_an_answer_or_a_value_error(data):
    try:
        answer = parse_answer("xvoltage?", data)
        parse_volts(answer.body)
    except ValueError:
        pass
    is_complete("xvoltage?", data)


@given(st.floats(-1, 151))
def test_measured_volts_come_back_within_half_their_resolution(volts):
    assert abs(parse_volts(format_volts(volts)) - volts) <= 0.0501


@given(st.lists(st.floats(0, 151), min_size=3, max_size=3))
def test_three_measured_volts_come_back(volts):
    assert parse_three_volts(format_three_volts(volts)) == pytest.approx(volts, abs=0.0501)


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
