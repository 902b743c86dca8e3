"""Mock drives that share an adapter: each answers for its own node, and has faults of its own."""

import asyncio

import pytest
from cia402_bus import Bus
from instruments.mock_bench import ToldMotors

from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.drivers.cia402 import protocol
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import SlcanAdapter
from fitctl.mocks.faults import WIRE_FAULTS, Faults

SIDEROSTAT = load_rig(default_rig_path()).loops["right"].siderostat
DEVICE_TYPE = protocol.encode_sdo(protocol.SDO_UPLOAD, protocol.DEVICE_TYPE, 0).hex()


def on_a_shared_bus(script):
    """Run a script with a raw client, and the mocks of nodes 1 and 2."""

    async def run():
        adapter = SlcanAdapter(1000000, Faults(WIRE_FAULTS))
        mocks = [
            Cia402DriveMock(
                SIDEROSTAT.model_copy(
                    update={"device": SIDEROSTAT.device.model_copy(update={"node_id": node})}
                ),
                ToldMotors(),
                port=0,
                adapter=adapter,
            )
            for node in (1, 2)
        ]
        bus = await Bus.on(await adapter.start(0))
        for mock in mocks:
            await mock.start()
        try:
            await script(bus, mocks)
        finally:
            bus.close()
            for mock in mocks:
                await mock.stop()
            await adapter.stop()

    asyncio.run(run())


async def answering(bus):
    """The nodes that answer a request to each."""
    for node in (1, 2):
        bus.send(protocol.SDO_REQUEST_BASE + node, DEVICE_TYPE)
    nodes = set()
    while True:
        try:
            can_id, _ = await bus.frame(0.3)
        except TimeoutError:
            return nodes
        if can_id & ~0x7F == protocol.SDO_RESPONSE_BASE:
            nodes.add(can_id & 0x7F)


def test_each_node_answers_requests_to_itself():
    async def script(bus, _mocks):
        assert await answering(bus) == {1, 2}

    on_a_shared_bus(script)


@pytest.mark.parametrize("kind", ["drop", "disconnect", "freeze", "link_loss"])
def test_a_drive_that_is_away_leaves_the_adapter_and_the_other_drive(kind):
    async def script(bus, mocks):
        mocks[0].faults.set(Fault(device="right.drive", kind=kind))
        assert await answering(bus) == {2}
        mocks[0].faults.clear()
        assert await answering(bus) == {1, 2}

    on_a_shared_bus(script)


def test_a_frame_with_a_turned_bit_is_another_frame_or_none():
    async def script(bus, mocks):
        mocks[0].faults.set(Fault(device="right.drive", kind="corrupt"))
        assert 2 in await answering(bus)

    on_a_shared_bus(script)
