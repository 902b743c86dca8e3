"""Each driver over a bad wire, on virtual time: no answer is taken for another's, and every call ends."""

from random import Random
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.swarm.drivers import BENCHES, Mistaken, drawn_run, run_wire
from benchmarks.swarm.wires import KINDS, Trouble
from fitctl.drivers.c887.link import C887Link
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.modbus_dac import link as dac_link
from fitctl.drivers.modbus_dac.driver import ModbusDac

TROUBLES = st.builds(
    Trouble, kind=st.sampled_from(KINDS), for_s=st.floats(3e-4, 2.0, allow_nan=False)
)
CALLS = st.tuples(st.integers(0, 99), st.sampled_from([0.0, 0.002, 0.02, 0.3]))


def random_nights(name):
    for seed in range(40):
        run_wire(name, *drawn_run(Random(f"{seed} {name}")))


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


@pytest.mark.long
@pytest.mark.parametrize("name", BENCHES)
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


class Unread:
    """A port that never shows what has arrived."""

    def __init__(self, port):
        self._port = port
        self.in_waiting = 0

    def __getattr__(self, name):
        return getattr(self._port, name)


def unread(self):
    """What arrived late is not noticed before the next question."""
    self._port = Unread(self._port)


POP, SEND, NUMBER = dac_link.pop_answer, dac_link.TcpLink.send, [0]
MISTAKES = {
    "D/A over Modbus/TCP": [
        (dac_link, "pop_answer", any_number),
        (dac_link.TcpLink, "send", numbered),
    ],
    "D/A over Modbus RTU": [
        (ModbusDac, "confirm", lambda self: setattr(self, "_unconfirmed", None))
    ],
    "LabJack T7": [(LabJackT7, "_request_of", oldest_request)],
    "C-887": [(C887Link, "resynchronise", unread)],
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_driver_that_takes_any_answer_is_found(name):
    patches = [patch.object(*mistake) for mistake in MISTAKES[name]]
    for each in patches:
        each.start()
    try:
        with pytest.raises(Mistaken):
            random_nights(name)
    finally:
        for each in patches:
            each.stop()
