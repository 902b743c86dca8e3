"""The SLCAN wire of the mock, as a transcript; and its frame codec."""

import asyncio
import string

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import Fault
from fitctl.mocks.cia402.slcan import CanFrame, SlcanAdapter, decode_frame, encode_frame
from fitctl.mocks.faults import WIRE_FAULTS, Faults

frames = st.builds(
    lambda can_id, extended, data, remote: CanFrame(
        can_id if extended else can_id & 0x7FF,
        b"" if remote is not None else data,
        extended,
        remote,
    ),
    st.integers(0, 0x1FFF_FFFF),
    st.booleans(),
    st.binary(max_size=8),
    st.none() | st.integers(0, 8),
)


@given(frames)
def test_a_frame_survives_the_wire(frame):
    line = encode_frame(frame)
    assert line.endswith(b"\r")
    assert decode_frame(line[:-1]) == frame


@given(st.binary(max_size=40) | st.text(string.hexdigits + "tTrR ", max_size=28).map(str.encode))
def test_a_line_is_a_frame_or_a_value_error(line):
    try:
        frame = decode_frame(line)
    except ValueError:
        return
    assert encode_frame(frame)[:-1].upper() == line.upper()


@pytest.mark.parametrize(
    "line", [b"", b"t", b"t1", b"t1239", b"t12321", b"t8000", b"T200000000", b"t1231 1", b"r123211"]
)
def test_malformed_frames_are_refused(line):
    with pytest.raises(ValueError, match=r"SLCAN|length"):
        decode_frame(line)


class Wire:
    """One raw TCP client."""

    def __init__(self, reader, writer):
        self._reader, self._writer = reader, writer

    async def tell(self, sent: bytes, expected: bytes) -> None:
        """Send, and see exactly this come back."""
        self._writer.write(sent)
        await self.see(expected)

    def write(self, sent: bytes) -> None:
        self._writer.write(sent)

    async def read(self, length: int) -> bytes:
        async with asyncio.timeout(3):
            return await self._reader.readexactly(length)

    async def skip_to(self, expected: bytes) -> None:
        seen = b""
        async with asyncio.timeout(3):
            while expected not in seen:
                piece = await self._reader.read(2**20)
                assert piece, "closed"
                seen = seen[-len(expected) :] + piece

    async def see(self, expected: bytes) -> None:
        async with asyncio.timeout(3):
            assert await self._reader.readexactly(len(expected)) == expected

    def close(self) -> None:
        self._writer.close()


async def connect(adapter):
    port = adapter._listener.sockets[0].getsockname()[1]
    return Wire(*await asyncio.open_connection("127.0.0.1", port))


def on_adapter(script, clients=1):
    """Run `script(received, adapter, wire, ...)` with an adapter and so many clients."""

    async def run():
        received = []
        adapter = SlcanAdapter(1000000, Faults(WIRE_FAULTS), received.append)
        port = await adapter.start(0)
        wires = [Wire(*await asyncio.open_connection("127.0.0.1", port)) for _ in range(clients)]
        try:
            await script(received, adapter, *wires)
        finally:
            for wire in wires:
                wire.close()
            await adapter.stop()

    asyncio.run(run())


def test_a_session():
    async def script(received, _adapter, wire):
        await wire.tell(b"\r\r", b"\r\r")
        await wire.tell(b"V\r", b"V1013\r")
        await wire.tell(b"N\r", b"NFIT1\r")
        await wire.tell(b"S8\rO\r", b"\r\r")
        await wire.tell(b"F\r", b"F00\r")
        await wire.tell(b"t0800\r", b"z\r")
        await wire.tell(b"t20182a00000000fF12\r", b"\a")
        await wire.tell(b"t20182a000000000000fF\r", b"z\r")
        await wire.tell(b"T1234567810A\r", b"Z\r")
        await wire.tell(b"r1818\r", b"z\r")
        await wire.tell(b"C\r", b"\r")
        assert received == [
            CanFrame(0x080, b""),
            CanFrame(0x201, bytes.fromhex("2a000000000000ff")),
            CanFrame(0x12345678, b"\x0a", extended=True),
            CanFrame(0x181, b"", remote_length=8),
        ]

    on_adapter(script)


def test_what_is_refused():
    async def script(received, _adapter, wire):
        await wire.tell(b"C\r", b"\a")  # not open
        await wire.tell(b"O\r", b"\a")  # no bit rate yet
        await wire.tell(b"S8\rO\r", b"\r\r")
        await wire.tell(b"O\r", b"\a")  # open already
        await wire.tell(b"S6\r", b"\a")  # not while open
        await wire.tell(b"Q\r", b"\a")  # no such command
        await wire.tell(b"C\r", b"\r")
        await wire.tell(b"t0800\r", b"\a")  # closed
        await wire.tell(b"x" * 40, b"\a")  # a line without an end
        assert received == []

    on_adapter(script)


def test_a_line_may_come_in_pieces():
    async def script(received, _adapter, wire):
        await wire.tell(b"S8\rO\rt08", b"\r\r")
        await wire.tell(b"00\r", b"z\r")
        assert received == [CanFrame(0x080, b"")]

    on_adapter(script)


def test_all_clients_share_one_bus():
    async def script(received, adapter, one, two):
        await one.tell(b"S8\rO\r", b"\r\r")
        await two.tell(b"S8\rO\r", b"\r\r")
        await one.tell(b"t12320102\r", b"z\r")
        await two.see(b"t12320102\r")
        adapter.send(0x701, b"\x05")
        await one.see(b"t701105\r")
        await two.see(b"t701105\r")
        assert received == [CanFrame(0x123, b"\x01\x02")]

    on_adapter(script, clients=2)


def test_at_another_bit_rate_nothing_is_heard():
    async def script(received, adapter, wire):
        await wire.tell(b"S6\rO\r", b"\r\r")
        adapter.send(0x701, b"\x05")
        await wire.tell(b"t0800\r", b"z\r")
        await wire.tell(b"F\r", b"F80\r")  # bus error, and nothing else came in between
        assert received == []

    on_adapter(script)


def test_a_listener_hears_and_is_not_let_speak():
    async def script(received, adapter, wire):
        await wire.tell(b"S8\rL\r", b"\r\r")
        adapter.send(0x701, b"\x05")
        await wire.see(b"t701105\r")
        await wire.tell(b"t0800\r", b"\a")
        await wire.tell(b"C\rO\r", b"\r\r")
        await wire.tell(b"t0800\r", b"z\r")
        assert received == [CanFrame(0x080, b"")]

    on_adapter(script)


def test_frames_are_stamped_with_milliseconds_where_that_is_wanted():
    async def script(_received, adapter, wire):
        await wire.tell(b"Z1\rS8\rO\r", b"\r\r\r")
        await wire.tell(b"Z0\r", b"\a")  # not while open
        adapter.send(0x701, b"\x05")
        await wire.see(b"t701105")
        stamp = await wire.read(5)
        assert int(stamp[:4], 16) < 60000
        assert stamp[4:] == b"\r"

    on_adapter(script)


@pytest.mark.long
def test_a_client_that_does_not_read_is_told_that_frames_were_lost():
    async def script(_received, adapter, wire):
        await wire.tell(b"S8\rO\r", b"\r\r")
        (client,) = adapter.links
        client.transport.set_write_buffer_limits(high=0)
        for _ in range(2_000_000):
            adapter.send(0x181, bytes(8))
            if client.transport.get_write_buffer_size() > 2**16:
                break
        adapter.send(0x181, bytes(8))
        backlog = client.transport.get_write_buffer_size()
        adapter.send(0x181, bytes(8))
        assert client.transport.get_write_buffer_size() == backlog
        wire.write(b"F\r")
        await wire.skip_to(b"F01\r")

    on_adapter(script)


@pytest.mark.parametrize("kind", ["disconnect", "reboot"])
def test_a_cut_connection_can_be_made_again_when_the_fault_is_over(kind):
    async def script(_received, adapter, wire):
        await wire.tell(b"S8\rO\r", b"\r\r")
        adapter.faults.set(Fault(device="right.drive", kind=kind))
        for one in (wire, await connect(adapter)):
            with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
                await one.tell(b"V\r", b"V1013\r")
        adapter.faults.clear()
        again = await connect(adapter)
        await again.tell(b"V\r", b"V1013\r")
        again.close()

    on_adapter(script)


def test_a_frozen_adapter_takes_nothing_and_says_nothing():
    async def script(received, adapter, wire):
        await wire.tell(b"S8\rO\r", b"\r\r")
        adapter.faults.set(Fault(device="right.drive", kind="freeze"))
        wire.write(b"t0800\r")
        adapter.send(0x701, b"\x05")
        await asyncio.sleep(0.05)
        adapter.faults.clear()
        await wire.tell(b"V\r", b"V1013\r")
        assert received == []

    on_adapter(script)


def test_answers_are_lost_line_by_line():
    async def script(received, adapter, wire):
        await wire.tell(b"S8\rO\r", b"\r\r")
        adapter.faults.set(Fault(device="right.drive", kind="drop"))
        wire.write(b"t0800\rt0800\r")
        while len(received) < 2:
            await asyncio.sleep(0)
        adapter.faults.clear()
        await wire.tell(b"V\r", b"V1013\r")

    on_adapter(script)


def test_behind_a_cut_can_cable_there_is_no_drive_but_other_clients():
    async def script(received, adapter, one, two):
        await one.tell(b"S8\rO\r", b"\r\r")
        await two.tell(b"S8\rO\r", b"\r\r")
        adapter.severed = True
        adapter.send(0x701, b"\x05")
        await one.tell(b"t12320102\r", b"z\r")
        await two.see(b"t12320102\r")
        await one.tell(b"F\r", b"F80\r")
        assert received == []

    on_adapter(script, clients=2)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=60), max_size=10))
def test_no_bytes_break_the_adapter(pieces):
    async def script(_received, adapter, wire):
        for piece in pieces:
            wire.write(piece)
        wire.write(b"\r\r")
        other = await connect(adapter)
        await other.tell(b"V\r", b"V1013\r")
        other.close()
        wire.write(b"\rN\r")
        await wire.skip_to(b"NFIT1\r")

    on_adapter(script)
