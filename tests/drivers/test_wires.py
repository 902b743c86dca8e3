"""Each driver over a bad wire, on virtual time: no answer is taken for another's, and every call ends."""

import re
from contextlib import ExitStack
from random import Random
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.swarm.wires.bench import Mistaken
from benchmarks.swarm.wires.camera_bench import run_camera
from benchmarks.swarm.wires.camera_wire import KINDS as CAMERA_KINDS
from benchmarks.swarm.wires.camera_wire import RARE_KINDS
from benchmarks.swarm.wires.drivers import BENCHES, NIGHTS, run_wire
from benchmarks.swarm.wires.wire import KINDS, Trouble
from fitctl.drivers.c887.link import C887Link
from fitctl.drivers.cia402.node import Node
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.ensemble import driver as ensemble
from fitctl.drivers.ensemble.link import EnsembleLink
from fitctl.drivers.gige import gvcp, heartbeat
from fitctl.drivers.gige.stream import FrameAssembler
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.mdt693 import driver as mdt693
from fitctl.drivers.modbus_dac import link as dac_link
from fitctl.drivers.modbus_dac.driver import ModbusDac

TROUBLES = st.builds(
    Trouble, kind=st.sampled_from(KINDS), for_s=st.floats(3e-4, 2.0, allow_nan=False)
)
CALLS = st.tuples(st.integers(0, 99), st.sampled_from([0.0, 0.002, 0.02, 0.3]))


def random_nights(name):
    for seed in range(40):
        NIGHTS[name](Random(f"{seed} {name}"))


@pytest.mark.parametrize("name", BENCHES)
@settings(
    derandomize=True,
    max_examples=15,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
@given(
    troubles=st.lists(st.none() | TROUBLES, max_size=60),
    calls=st.lists(CALLS, min_size=1, max_size=15),
)
def test_no_answer_is_taken_for_another_and_every_call_ends(name, troubles, calls):
    ended = run_wire(name, troubles, calls)

    assert sum(ended.values()) == len(calls)


CAMERA_TROUBLES = st.builds(
    Trouble,
    kind=st.sampled_from(CAMERA_KINDS + RARE_KINDS),
    for_s=st.floats(3e-4, 2.0, allow_nan=False),
)


@settings(
    derandomize=True,
    max_examples=15,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
@given(
    control=st.lists(st.none() | CAMERA_TROUBLES, max_size=30),
    stream=st.lists(st.none() | CAMERA_TROUBLES, max_size=60),
    calls=st.lists(CALLS, min_size=1, max_size=15),
)
def test_no_frame_is_of_two_and_every_call_to_the_camera_ends(control, stream, calls):
    ended = run_camera(control, stream, calls)

    assert sum(ended.values()) == len(calls)


def test_a_good_network_brings_frames_alone():
    assert run_camera([], [], [(number, 0.02) for number in range(20)]) == {"value": 20}


@pytest.mark.long
@pytest.mark.parametrize("name", NIGHTS)
def test_random_nights_on_a_bad_wire(name):
    random_nights(name)


@pytest.mark.parametrize("name", BENCHES)
def test_a_good_wire_brings_values_alone(name):
    calls = [(number, 0.02) for number in range(20)]

    assert run_wire(name, [], calls) == {"value": 20}


def any_number(pending):
    """The next answer, whichever request it is to."""
    answer = POP(pending)
    return answer and answer._replace(transaction=NUMBER[0])


def numbered(self, request):
    SEND(self, request)
    NUMBER[0] = self._transaction


def oldest_request(self, _answer):
    return self._outstanding.popleft() if self._outstanding else None


class SomePort:
    """A port that says how much of what has arrived it shows."""

    def __init__(self, port, in_waiting):
        vars(self).update(_port=port, in_waiting=in_waiting)

    def __getattr__(self, name):
        return getattr(self._port, name)

    def __setattr__(self, name, value):
        setattr(self._port, name, value)


def unread(self):
    """What arrived late is not noticed before the next question."""
    self._port = SomePort(self._port, in_waiting=0)


def open_unread(self, device):
    OPEN_ENSEMBLE(self, device)
    unread(self)


def byte_by_byte(self, *arguments, **options):
    """What follows an answer is left for the next question."""
    return SomePort(OPEN_SERIAL(self, *arguments, **options), in_waiting=1)


def its_question(data):
    """The question that an answer begins with."""
    return data.decode("ascii", "replace").lstrip(MDT693_FRAME).partition("\r")[0]


def complete_to_any(_command, data):
    return COMPLETE(its_question(data), data.lstrip(MDT693_FRAME.encode()))


def answer_to_any(_command, data):
    return PARSE(its_question(data), data.lstrip(MDT693_FRAME.encode()))


def any_bits(text):
    """A position passes for bits."""
    return int(float(text))


def request(self, frame, what, **options):
    SDO[0] = frame
    return REQUEST_SDO(self, frame, what, **options)


def any_object(self, data):
    """The next answer, whichever object it is of."""
    self._answer = data[:1] + SDO[0][1:4] + data[4:]


def any_answer(packet):
    """The next answer, whichever request it is to."""
    answer = DECODE(packet)
    return answer._replace(request_id=REQUEST[0])


def request_id(self):
    REQUEST[0] = NEXT_ID(self)
    return REQUEST[0]


def any_frame(self, block_id):
    """One frame at a time: what comes is of it."""
    return next(iter(self._open.values()), None) or BEGIN(self, block_id)


def uncounted(self, block):
    counted = self.packets_lost
    MISS(self, block)
    self.packets_lost = counted


DECODE, REQUEST, NEXT_ID = gvcp.protocol.decode_answer, [0], gvcp.ControlChannel._next_id
BEGIN, MISS = FrameAssembler._begin, FrameAssembler._miss
OPEN_ENSEMBLE, OPEN_SERIAL = EnsembleLink.__init__, Endpoint.open_serial
COMPLETE, PARSE, MDT693_FRAME = mdt693.is_complete, mdt693.parse_answer, " \r\n\0>*"
REQUEST_SDO, SDO = Node._request, [b""]
POP, SEND, NUMBER = dac_link.pop_answer, dac_link.TcpLink.send, [0]
MISTAKES = {
    "D/A over Modbus/TCP": [
        (dac_link, "pop_answer", any_number),
        (dac_link.TcpLink, "send", numbered),
    ],
    "D/A over Modbus RTU": [
        (ModbusDac, "confirm", lambda self: setattr(self, "_unconfirmed", None))
    ],
    "MDT693": [
        (Endpoint, "open_serial", byte_by_byte),
        (mdt693, "is_complete", complete_to_any),
        (mdt693, "parse_answer", answer_to_any),
    ],
    "Ensemble": [(EnsembleLink, "__init__", open_unread), (ensemble, "parse_bits", any_bits)],
    "CiA 402 over SLCAN": [(Node, "_request", request), (Node, "_on_sdo", any_object)],
    "LabJack T7": [(LabJackT7, "_request_of", oldest_request)],
    "C-887": [(C887Link, "resynchronise", unread)],
}


CAMERA_MISTAKES = {
    "any answer": [
        (gvcp.protocol, "decode_answer", any_answer),
        (gvcp.ControlChannel, "_next_id", request_id),
    ],
    "packets of any frame": [(FrameAssembler, "_begin", any_frame)],
    "lost packets that are not counted": [(FrameAssembler, "_miss", uncounted)],
    "a restart that is not noticed": [(heartbeat.Heartbeat, "_lose", lambda _self, _error: None)],
}


def find(name, mistakes):
    with ExitStack() as stack:
        for mistake in mistakes:
            stack.enter_context(patch.object(*mistake))
        with pytest.raises(Mistaken) as found:
            random_nights(name)
    return str(found.value)


@pytest.mark.long
@pytest.mark.parametrize("name", MISTAKES)
def test_a_driver_that_takes_any_answer_is_found(name):
    find(name, MISTAKES[name])


@pytest.mark.long
@pytest.mark.parametrize(
    ("mistake", "shows"),
    [
        ("any answer", "register|identity|camera says|heartbeat set|does not run"),
        ("packets of any frame", "is of several|is frame"),
        ("lost packets that are not counted", "0 lost packets counted"),
        ("a restart that is not noticed", "is not noticed"),
    ],
)
def test_a_mistake_in_the_camera_driver_is_found(mistake, shows):
    assert re.search(shows, find("camera", CAMERA_MISTAKES[mistake]))
