"""Request PDU in, answer PDU out; read these as transcripts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.mocks.modbus.pdu import DataModel, DeviceFailure, Refusal, answer

BROKEN = 0xDEAD


class Station:
    """Holding registers 0-3 and 100."""

    def __init__(self):
        self.values = dict.fromkeys([0, 1, 2, 3, 100], 7)
        self.model = DataModel(
            set(self.values), self.read, self.write, (b"maker", b"model", b"1.0")
        )

    def read(self, address, count):
        values = [self.values[address + place] for place in range(count)]
        if BROKEN in values:
            raise DeviceFailure
        return values

    def write(self, address, values):
        if BROKEN in values:
            raise DeviceFailure
        for place, value in enumerate(values):
            assert address + place in self.values
            self.values[address + place] = value

    def says(self, request):
        return answer(bytes.fromhex(request), self.model).hex(" ")


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        ("03 00 00 00 02", "03 04 00 07 00 07"),
        ("06 00 64 ab cd", "06 00 64 ab cd"),
        ("10 00 01 00 02 04 00 0a 01 02", "10 00 01 00 02"),
        ("17 00 00 00 03 00 01 00 01 02 00 ff", "17 06 00 07 00 ff 00 07"),
    ],
    ids=lambda text: text[:2],
)
def test_every_function_is_carried_out_and_answered(request_, expected):
    assert Station().says(request_) == expected


def test_what_is_written_is_read_back():
    station = Station()
    station.says("10 00 01 00 02 04 00 0a 01 02")
    assert station.says("03 00 00 00 04") == "03 08 00 07 00 0a 01 02 00 07"


@pytest.mark.parametrize("function", [0, 1, 2, 4, 5, 7, 8, 15, 0x14, 0x16, 0x18, 0x64, 0x7F])
def test_an_unknown_function_is_exception_01_whatever_else_is_wrong(function):
    assert Station().says(f"{function:02x} ff ff") == f"{function | 0x80:02x} 01"


@pytest.mark.parametrize(
    "request_",
    [
        "03 ff ff 00 00",
        "03 ff ff 00 7e",
        "03 ff ff",
        "03 00 00 00 01 00",
        "06 ff ff 00",
        "10 ff ff 00 00 00",
        "10 ff ff 00 02 02 00 00",
        "10 ff ff 00 02 04 00 00",
        pytest.param("10 ff ff 00 7c f8" + " 00" * 248, id="10 ff ff 00 7c f8 ..."),
        "17 ff ff 00 00 00 00 00 01 02 00 00",
        "17 ff ff 00 7e 00 00 00 01 02 00 00",
        "17 ff ff 00 01 00 00 00 00 00",
        pytest.param(
            "17 ff ff 00 01 00 00 00 7a f4" + " 00" * 244, id="17 ff ff 00 01 00 00 00 7a f4 ..."
        ),
        "17 ff ff 00 01 00 00 00 01 04 00 00",
    ],
)
def test_a_wrong_quantity_or_length_is_exception_03_even_where_the_address_is_wrong_too(request_):
    function = int(request_[:2], 16)
    assert Station().says(request_) == f"{function | 0x80:02x} 03"


@pytest.mark.parametrize(
    "request_",
    [
        "03 00 03 00 02",
        "03 ff ff 00 02",
        "06 00 04 00 00",
        "10 00 03 00 02 04 00 00 00 00",
        "17 00 00 00 01 00 04 00 01 02 00 00",
        "17 00 04 00 01 00 00 00 01 02 00 00",
    ],
)
def test_an_address_that_does_not_exist_is_exception_02_and_nothing_is_written(request_):
    station = Station()
    before = Station().values
    function = int(request_[:2], 16)
    assert station.says(request_) == f"{function | 0x80:02x} 02"
    assert station.values == before


@pytest.mark.parametrize(
    "request_",
    ["06 00 00 de ad", "10 00 00 00 01 02 de ad", "17 00 00 00 01 00 01 00 01 02 de ad"],
)
def test_what_the_device_cannot_do_is_exception_04(request_):
    function = int(request_[:2], 16)
    assert Station().says(request_) == f"{function | 0x80:02x} 04"


def test_a_device_says_itself_which_functions_it_has_and_what_it_refuses():
    def refuse(_address, _values):
        raise Refusal(3)

    model = DataModel(range(2), lambda _first, count: [7] * count, refuse, (), {4, 6})
    assert answer(bytes.fromhex("04 00 00 00 02"), model).hex(" ") == "04 04 00 07 00 07"
    assert answer(bytes.fromhex("04 00 01 00 02"), model).hex(" ") == "84 02"
    assert answer(bytes.fromhex("06 00 00 00 01"), model).hex(" ") == "86 03"
    for lacking in ("03 00 00 00 02", "10 00 00 00 01 02 00 00", "2b 0e 01 00"):
        function = int(lacking[:2], 16)
        assert answer(bytes.fromhex(lacking), model).hex(" ") == f"{function | 0x80:02x} 01"


ALL_OBJECTS = "00 05 6d 61 6b 65 72 01 05 6d 6f 64 65 6c 02 03 31 2e 30"


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        ("2b 0e 01 00", f"2b 0e 01 81 00 00 03 {ALL_OBJECTS}"),
        ("2b 0e 03 00", f"2b 0e 03 81 00 00 03 {ALL_OBJECTS}"),
        ("2b 0e 01 02", "2b 0e 01 81 00 00 01 02 03 31 2e 30"),
        ("2b 0e 01 50", f"2b 0e 01 81 00 00 03 {ALL_OBJECTS}"),
        ("2b 0e 04 01", "2b 0e 04 81 00 00 01 01 05 6d 6f 64 65 6c"),
        ("2b 0e 04 03", "ab 02"),
        ("2b 0e 05 00", "ab 03"),
        ("2b 0e 00 00", "ab 03"),
        ("2b 0e 01", "ab 03"),
        ("2b 0d 00 00", "ab 01"),
        ("2b", "ab 01"),
    ],
)
def test_identification_is_a_stream_or_one_object(request_, expected):
    assert Station().says(request_) == expected


@given(st.binary(min_size=1, max_size=253))
def test_every_request_gets_its_own_answer_or_an_exception_of_the_standard(request_):
    got = answer(request_, Station().model)
    assert len(got) <= 253
    if got[0] == request_[0] & 0x7F and request_[0] < 0x80:
        assert len(got) >= 3
    else:
        assert got[0] == request_[0] | 0x80
        assert len(got) == 2
        assert got[1] in {1, 2, 3, 4}


@given(
    st.sampled_from([1, 2, 3, 4, 5, 6, 15, 16, 23]),
    st.lists(st.sampled_from([0, 1, 2, 3, 16, 100, 0xFF00, BROKEN]), min_size=2, max_size=8),
)
def test_likely_requests_too(function, words):
    body = b"".join(word.to_bytes(2, "big") for word in words)
    got = answer(bytes([function]) + body, Station().model)
    assert got[0] & 0x7F == function
