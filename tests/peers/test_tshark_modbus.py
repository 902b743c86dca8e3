"""tshark takes what a master and the D/A mock say to each other apart, and finds nothing wrong with it."""

import asyncio
import shutil
import subprocess

import pytest

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
REQUESTS = [
    "03 00 00 00 03",
    "10 00 00 00 03 06 00 00 80 00 ff ff",
    "06 00 01 00 63",
    "17 00 00 00 03 00 01 00 02 04 00 0b 00 16",
    "2b 0e 01 00",
    "2b 0e 04 01",
    "03 00 03 00 01",
    "03 00 00 00 00",
    "04 00 00 00 01",
]
FUNCTIONS = ["3", "16", "6", "23", "43", "43", "3", "3", "4"]
EXCEPTIONS = ["", "", "", "", "", "", "2", "3", "1"]


async def conversation():
    """Both directions, message by message."""
    mock = ModbusDacMock(
        RIG.loops["right"].fsm.dac, RIG.mocks.loops["right"].dac, lambda volts: None, port=0
    )
    said = []
    try:
        ends = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", ends.tcp_port)
        for number, request in enumerate(map(bytes.fromhex, REQUESTS), 1):
            message = number.to_bytes(2, "big") + bytes(2)
            message += (1 + len(request)).to_bytes(2, "big") + b"\1" + request
            writer.write(message)
            header = await asyncio.wait_for(reader.readexactly(6), 5)
            said += [message, header + await reader.readexactly(header[5])]
        writer.close()
    finally:
        await mock.stop()
    return said


def test_every_message_is_sound_and_is_what_it_was_meant_to_be(tmp_path):
    said = asyncio.run(conversation())
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
    assert [row[0] for row in requests] == FUNCTIONS
    assert [row[:2] for row in answers] == [
        list(pair) for pair in zip(FUNCTIONS, EXCEPTIONS, strict=True)
    ]
    assert [row[2:] for row in rows] == [["", ""]] * len(said), shown
