"""tshark takes what a master and the Modbus mocks say to each other apart, and finds nothing wrong with it."""

import asyncio
import shutil
import subprocess

import pytest
from instruments.labjack_bench import Bench

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.modbus_dac.server import ModbusDacMock

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("tshark") is None or shutil.which("text2pcap") is None,
        reason="tshark is not installed: Debian package tshark",
    ),
]

RIG = load_rig(default_rig_path())


def dac_mock():
    """The D/A."""
    loop, mocks = RIG.loops["right"], RIG.mocks.loops["right"]
    return ModbusDacMock(loop.fsm.dac, mocks.dac, lambda volts: None, port=0)


# A mock, and what it is asked: a request, its function, and the exception that answers it, if one does.
CONVERSATIONS = {
    "D/A": (
        dac_mock,
        [
            ("03 00 00 00 03", "3", ""),
            ("10 00 00 00 03 06 00 00 80 00 ff ff", "16", ""),
            ("06 00 01 00 63", "6", ""),
            ("17 00 00 00 03 00 01 00 02 04 00 0b 00 16", "23", ""),
            ("2b 0e 01 00", "43", ""),
            ("2b 0e 04 01", "43", ""),
            ("03 00 03 00 01", "3", "2"),
            ("03 00 00 00 00", "3", "3"),
            ("04 00 00 00 01", "4", "1"),
        ],
    ),
    "LabJack T7": (
        lambda: Bench().mock,
        [
            ("03 ea 60 00 02", "3", ""),
            ("10 ab 7c 00 02 04 41 20 00 00", "16", ""),
            ("06 ab 7f 00 04", "6", ""),
            ("03 00 00 00 08", "3", ""),
            ("04 00 00 00 08", "4", ""),
            ("03 00 1c 00 02", "3", "2"),
            ("10 ab 7c 00 02 04 40 a0 00 00", "16", "3"),
            ("2b 0e 01 00", "43", "1"),
        ],
    ),
}


async def conversation(mock, requests):
    """Both directions, message by message."""
    said = []
    try:
        ends = await mock.start()
        port = ends if isinstance(ends, int) else ends.tcp_port
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for number, request in enumerate(map(bytes.fromhex, requests), 1):
            message = number.to_bytes(2, "big") + bytes(2)
            message += (1 + len(request)).to_bytes(2, "big") + b"\1" + request
            writer.write(message)
            header = await asyncio.wait_for(reader.readexactly(6), 5)
            said += [message, header + await reader.readexactly(header[5])]
        writer.close()
    finally:
        await mock.stop()
    return said


@pytest.mark.parametrize("name", CONVERSATIONS)
def test_every_message_is_sound_and_is_what_it_was_meant_to_be(tmp_path, name):
    make_mock, exchanges = CONVERSATIONS[name]

    async def talk():
        return await conversation(make_mock(), [request for request, _, _ in exchanges])

    said = asyncio.run(talk())
    # Requests and answers turn by turn, as text2pcap wants them: direction, offset, bytes.
    lines = [f"{'IO'[turn % 2]} 0000 {message.hex(' ')}\n" for turn, message in enumerate(said)]
    dump, capture = tmp_path / "said.txt", tmp_path / "said.pcap"
    dump.write_text("".join(lines))
    subprocess.run(
        ["text2pcap", "-q", "-D", "-T", "40000,502", str(dump), str(capture)],
        check=True,
        capture_output=True,
    )
    fields = ["modbus.func_code", "modbus.exception_code", "_ws.expert.message", "_ws.malformed"]
    shown = subprocess.run(
        ["tshark", "-r", str(capture), "-T", "fields", "-E", "separator=|"]
        + [part for field in fields for part in ("-e", field)],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    ).stdout
    rows = [line.split("|") for line in shown.splitlines()]
    requests, answers = rows[::2], rows[1::2]
    assert [row[0] for row in requests] == [function for _, function, _ in exchanges]
    assert [row[:2] for row in answers] == [[*answer] for _, *answer in exchanges]
    assert [row[2:] for row in rows] == [["", ""]] * len(said), shown
