"""tshark takes what the driver and the mock drive say on the bus apart, and finds nothing wrong with it."""

import asyncio
import shutil
import struct
import subprocess
import threading
from collections import Counter

import pytest
from can.interfaces.slcan import slcanBus
from instruments.mock_bench import ToldMotors

from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.mocks.cia402.drive import Cia402DriveMock

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("tshark") is None, reason="tshark is not installed: Debian package tshark"
    ),
]

LINKTYPE_CAN_SOCKETCAN = 227
PCAP_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN)
REMOTE = 0x4000_0000


class Recorder:
    """A third node that hears all, on a thread of its own."""

    def __init__(self, port):
        self.frames = []
        self._bus = slcanBus(f"socket://127.0.0.1:{port}", bitrate=1000000, sleep_after_open=0)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._done.is_set():
            message = self._bus.recv(0.02)
            if message is not None:
                self.frames.append(message)

    def close(self):
        self._done.set()
        self._thread.join(5)
        self._bus.shutdown()

    def pcap(self):
        """All frames, as SocketCAN's header and data; identifiers are big-endian there."""
        packets = [PCAP_HEADER]
        for number, frame in enumerate(self.frames):
            can_id = frame.arbitration_id | (REMOTE if frame.is_remote_frame else 0)
            packet = struct.pack(">IBxxx", can_id, frame.dlc) + bytes(frame.data)
            packets += [struct.pack("<IIII", number, 0, len(packet), len(packet)), packet]
        return b"".join(packets)


@pytest.fixture
def conversation(in_loop):
    """The driver opens, enables, exchanges, meets a fault, resets and closes, before a recorder."""
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat

    async def made():
        mock = Cia402DriveMock(siderostat, ToldMotors(1.0, -1.0), port=0)
        return mock, await mock.start()

    async def set_fault(mock, on):
        if on:
            mock.faults.set(Fault(device="right.drive", kind="amplifier_fault"))
        else:
            mock.faults.clear()

    mock, port = in_loop(made())
    recorder = Recorder(port)
    device = siderostat.device.model_copy(update={"channel": f"socket://127.0.0.1:{port}"})
    amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"device": device}))
    amplifiers.open()
    amplifiers.enable()
    for _ in range(50):
        amplifiers.exchange((1.0, -1.0))
    in_loop(set_fault(mock, True))
    amplifiers.exchange((0.0, 0.0))
    in_loop(set_fault(mock, False))
    amplifiers.reset_fault()
    amplifiers.close()
    in_loop(asyncio.sleep(0.2))  # what was sent last is heard
    recorder.close()
    in_loop(mock.stop())
    return recorder


def test_every_frame_is_sound_and_is_what_it_was_meant_to_be(conversation, tmp_path):
    capture = tmp_path / "canopen.pcap"
    capture.write_bytes(conversation.pcap())
    told = subprocess.run(
        [
            *("tshark", "-r", str(capture), "-d", "can.subdissector,canopen", "-T", "fields"),
            *("-e", "canopen.function_code", "-e", "_ws.malformed", "-e", "_ws.expert"),
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    rows = [line.split("\t") for line in told]
    assert len(rows) == len(conversation.frames) > 200
    assert {row[1] for row in rows} == {""}, "malformed"
    assert {row[2] for row in rows} == {""}, "expert"
    by_function = Counter(int(row[0], 16) for row in rows)
    nmt, sync_or_emcy, tpdo1, rpdo1, tpdo2, sdo_answer, sdo_request, heartbeat = (
        by_function[code] for code in (0, 1, 3, 4, 5, 11, 12, 14)
    )
    assert nmt >= 2
    assert sync_or_emcy > rpdo1 >= 50
    assert tpdo1 >= 50
    assert tpdo2 >= 4
    assert sdo_answer == sdo_request > 50
    assert heartbeat >= 2
