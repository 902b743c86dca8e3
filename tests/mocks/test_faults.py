import asyncio

import pytest
from instruments.mock_bench import in_a_loop

from fitctl.config import Fault
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults, UnknownFault, Wire

KINDS = WIRE_FAULTS | {
    "hot_pixel": FaultKind("a pixel shines", "DN", 5000.0),
    "stuck": FaultKind("an axis does not move", parts=("az", "el")),
}


@pytest.fixture
def faults():
    return Faults(KINDS)


def fault(kind, **settings):
    return Fault(device="right.drive", kind=kind, **settings)


async def sent_through(faults, *messages, wait_s=0.0):
    sent = []
    wire = Wire(faults, sent.append)
    for message in messages:
        wire.send(message)
    await asyncio.sleep(wait_s)
    wire.close()
    return sent


# ---------------------------------------------------------------- what is wrong


def test_all_is_well_until_told(faults):
    assert faults.value("delay") is None
    assert not faults.strikes("drop")
    assert faults.active == []


@in_a_loop
async def test_a_fault_has_its_own_value_or_its_kinds(faults):
    faults.set(fault("hot_pixel"))
    assert faults.value("hot_pixel") == 5000.0
    faults.set(fault("hot_pixel", value=100.0))
    assert faults.value("hot_pixel") == 100.0
    assert len(faults.active) == 1


@in_a_loop
async def test_a_fault_of_all_is_one_of_each_part_and_not_the_other_way_round(faults):
    faults.set(fault("stuck", part="az"))
    assert faults.strikes("stuck", "az")
    assert not faults.strikes("stuck", "el")
    faults.set(fault("stuck"))
    assert faults.strikes("stuck", "el")


@in_a_loop
async def test_it_ends_by_itself_or_when_cleared_and_watchers_hear_of_it(faults):
    heard = []
    faults.on_change(heard.append)
    faults.set(fault("drop", for_s=0.01))
    faults.set(fault("delay"))
    await asyncio.sleep(0.05)
    assert [one.kind for one in faults.active] == ["delay"]
    faults.clear("delay")
    assert faults.active == []
    assert heard == ["drop", "delay", "drop", "delay"]


@in_a_loop
async def test_a_second_fault_of_a_kind_lasts_its_own_time(faults):
    faults.set(fault("drop", for_s=0.01))
    faults.set(fault("drop"))
    await asyncio.sleep(0.05)
    assert faults.strikes("drop")


@in_a_loop
async def test_a_reboot_ends_when_the_device_is_up_again(faults):
    faults.set(fault("reboot", value=0.01))
    assert faults.value("reboot") is not None
    await asyncio.sleep(0.05)
    assert faults.value("reboot") is None


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (fault("melt"), "right.drive has no fault melt; it has drop, delay"),
        (fault("stuck", part="x"), "no part x; it has az, el"),
        (fault("drop", part="az"), "it is of the whole device"),
        (fault("drop", value=1.0), "takes no value"),
    ],
)
def test_what_cannot_be_is_said(faults, wrong, said):
    with pytest.raises(UnknownFault, match=said):
        faults.set(wrong)


@in_a_loop
async def test_a_probability_hits_as_often_as_it_says(faults):
    faults.set(fault("drop", probability=0.25))
    assert 180 < sum(faults.strikes("drop") for _ in range(1000)) < 320


# ---------------------------------------------------------------- what that makes of messages


@in_a_loop
async def test_messages_pass_at_once_where_all_is_well(faults):
    assert await sent_through(faults, b"1", b"2") == [b"1", b"2"]


@in_a_loop
async def test_messages_are_lost(faults):
    faults.set(fault("drop"))
    assert await sent_through(faults, b"1", b"2") == []


@in_a_loop
async def test_one_bit_is_turned(faults):
    faults.set(fault("corrupt"))
    (sent,) = await sent_through(faults, b"hello")
    differing = int.from_bytes(sent, "big") ^ int.from_bytes(b"hello", "big")
    assert differing.bit_count() == 1


@in_a_loop
async def test_messages_come_twice(faults):
    faults.set(fault("duplicate"))
    assert await sent_through(faults, b"1", b"2") == [b"1", b"1", b"2", b"2"]


@in_a_loop
async def test_a_message_comes_after_the_next_or_after_a_while(faults):
    faults.set(fault("reorder"))
    assert await sent_through(faults, b"1", b"2", b"3", wait_s=0.3) == [b"2", b"1", b"3"]


@in_a_loop
async def test_messages_come_later_and_in_order(faults):
    faults.set(fault("delay", value=0.05))
    sent = []
    wire = Wire(faults, sent.append)
    wire.send(b"1")
    wire.send(b"2")
    assert sent == []
    await asyncio.sleep(0.2)
    assert sent == [b"1", b"2"]


@pytest.mark.parametrize("kind", ["freeze", "disconnect", "reboot"])
@in_a_loop
async def test_a_dead_wire_carries_nothing(faults, kind):
    wire = Wire(faults, lambda _: None)
    assert not wire.dead
    faults.set(fault(kind))
    assert wire.dead
    assert await sent_through(faults, b"1") == []
    faults.close()


@in_a_loop
async def test_what_is_still_to_be_sent_dies_with_the_connection(faults):
    faults.set(fault("delay", value=0.01))
    sent = []
    wire = Wire(faults, sent.append)
    wire.send(b"1")
    wire.close()
    await asyncio.sleep(0.05)
    assert sent == []
