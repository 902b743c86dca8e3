"""A Modbus server that needs its time for each request, and has room for some clients only."""

import asyncio
import contextlib

import pytest
from instruments.mock_bench import in_a_loop

from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.modbus.pdu import DataModel
from fitctl.mocks.modbus.tcp import ModbusTcpServer, frame

SERVICE_S = 0.05
CUT_OFF = (ConnectionError, asyncio.IncompleteReadError)
READ_ONE = bytes.fromhex("03 00 00 00 01")


@contextlib.asynccontextmanager
async def served(**limits):
    """A server of one register, and what connects a client to it."""
    clients = []
    model = DataModel(range(1), lambda _first, count: [7] * count, lambda *_: None, ())
    server = ModbusTcpServer(model, Faults(WIRE_FAULTS), unit=1, unknown_unit="serve", **limits)
    port = await server.start(0)

    async def connect():
        clients.append(await asyncio.open_connection("127.0.0.1", port))
        return clients[-1]

    try:
        yield connect
    finally:
        for _, writer in clients:
            writer.close()
        await server.stop()


async def answers_to(client, requests):
    """Send requests at once; gives the numbers of the answers and when each came."""
    reader, writer = client
    writer.write(b"".join(frame(number, 1, READ_ONE) for number in requests))
    came = []
    for _ in requests:
        data = await asyncio.wait_for(reader.readexactly(11), 5)
        came.append((int.from_bytes(data[:2], "big"), asyncio.get_running_loop().time()))
    return came


@in_a_loop
async def test_requests_are_answered_in_turn_and_each_takes_its_time():
    async with served(service_s=lambda pdu: SERVICE_S) as connect:
        began_s = asyncio.get_running_loop().time()
        came = await answers_to(await connect(), [1, 2, 3])
    assert [number for number, _ in came] == [1, 2, 3]
    for turn, (_, at_s) in enumerate(came, 1):
        assert at_s - began_s >= turn * SERVICE_S


@in_a_loop
async def test_two_clients_wait_for_each_other():
    async with served(service_s=lambda pdu: SERVICE_S) as connect:
        one, other = await connect(), await connect()
        began_s = asyncio.get_running_loop().time()
        both = await asyncio.gather(answers_to(one, [1, 2]), answers_to(other, [3, 4]))
    last_s = max(at_s for came in both for _, at_s in came)
    assert last_s - began_s >= 4 * SERVICE_S


@in_a_loop
async def test_who_leaves_before_its_turn_holds_up_nobody():
    served_pdus = []

    def service_s(pdu):
        served_pdus.append(pdu)
        return SERVICE_S

    async with served(service_s=service_s) as connect:
        _, leaving = await connect()
        leaving.write(frame(1, 1, READ_ONE) * 3)
        while not served_pdus:
            await asyncio.sleep(0.001)
        leaving.transport.abort()
        ((number, _),) = await answers_to(await connect(), [9])
    assert number == 9
    assert len(served_pdus) == 2  # the one that was under way, and ours


@in_a_loop
async def test_who_sends_far_ahead_of_its_turn_is_cut_off():
    async with served(service_s=lambda pdu: 10.0) as connect:
        reader, writer = await connect()
        writer.write(frame(1, 1, READ_ONE) * 3000)
        with pytest.raises(CUT_OFF):
            await asyncio.wait_for(reader.readexactly(1), 5)


@in_a_loop
async def test_one_client_too_many_is_cut_off_and_has_room_when_another_leaves():
    async with served(clients_max=2) as connect:
        one, other = await connect(), await connect()
        refused, _ = await connect()
        with pytest.raises(CUT_OFF):
            await asyncio.wait_for(refused.readexactly(1), 5)
        for client in (one, other):
            assert len(await answers_to(client, [1])) == 1
        other[1].close()
        await other[1].wait_closed()
        await asyncio.sleep(0.05)
        assert len(await answers_to(await connect(), [1])) == 1
