"""What keeps coming from the bus or the drive must not hold the servo."""

import contextlib
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from fitctl.drivers.cia402 import link as link_module
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.link import CanLink
from fitctl.drivers.cia402.node import Node
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceProtocolError, DeviceTimeout


@pytest.fixture
def link_that_repeats(siderostat, monkeypatch):
    """A link to an adapter that sends a line without end, faster than it can be read."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        channel = f"socket://127.0.0.1:{listener.getsockname()[1]}"

        def open_link(line: bytes) -> CanLink:
            link = CanLink(siderostat.device.model_copy(update={"channel": channel}))
            stack.callback(link.close)
            always_ready = SimpleNamespace(select=lambda *_: ([0], [], []))
            endless = SimpleNamespace(read=lambda _descriptor, size: line * (size // len(line)))
            monkeypatch.setattr(link_module, "select", always_ready)
            monkeypatch.setattr(link_module, "os", endless)
            return link

        yield open_link


def within(seconds, action):
    """Run `action` where an endless loop fails the test and not the whole run."""
    results = []
    thread = threading.Thread(target=lambda: results.append(action()), daemon=True)
    thread.start()
    thread.join(seconds)
    assert results, f"not done within {seconds} s"
    return results[0]


@pytest.mark.parametrize("line", [b"z\r", b"T000000010\r"], ids=["acks", "extended frames"])
def test_lines_that_concern_nobody_do_not_outlast_the_time_limit(link_that_repeats, line):
    link = link_that_repeats(line)
    assert within(3.0, lambda: link.receive(0.0) is None)
    assert within(3.0, lambda: link.receive(0.01) is None)


def test_bytes_without_a_line_end_are_no_can_frames(link_that_repeats):
    def receive():
        with pytest.raises(DeviceProtocolError, match="without a line end"):
            link.receive(1.0)
        return True

    link = link_that_repeats(b"\0")
    assert within(3.0, receive)


def test_draining_a_flooded_bus_comes_to_an_end(link_that_repeats, siderostat):
    node = Node(link_that_repeats(b"t1008" + b"00" * 8 + b"\r"), siderostat.device)
    assert within(3.0, lambda: node.drain() is None)


class SegmentingDrive:
    """A link to a drive whose uploads go on and on: `segments` of seven bytes, then the last."""

    endpoint = Endpoint("drive", "nowhere")

    def __init__(self, segments=None, announced=None, delay_s=0.0):
        self._left = segments
        self._announced = announced
        self._delay_s = delay_s
        self._answer = None

    def send(self, frame):
        request = frame[1]
        if request[0] == protocol.SDO_UPLOAD:
            size = self._announced
            given = 0 if size is None else protocol.SDO_SIZE_GIVEN
            start = bytes([protocol.SDO_UPLOAD | given]) + request[1:4]
            self._answer = start + (size or 0).to_bytes(4, "little")
        elif request[0] & protocol.SDO_SPECIFIER == protocol.SDO_UPLOAD_SEGMENT:
            if self._left is not None:
                self._left -= 1
            toggle = request[0] & protocol.SDO_TOGGLE
            self._answer = protocol.encode_segment(b"chatter", toggle, last=self._left == 0)

    def receive(self, timeout_s):
        if self._answer is None:
            time.sleep(min(timeout_s, 0.001))
            return None
        time.sleep(self._delay_s)
        data, self._answer = self._answer, None
        return protocol.SDO_RESPONSE_BASE + 1, data


def upload(siderostat, *, response_timeout_s=5.0, **drive):
    device = siderostat.device.model_copy(update={"response_timeout_s": response_timeout_s})
    return Node(SegmentingDrive(**drive), device).upload(protocol.DEVICE_NAME, 0)


@pytest.mark.parametrize("announced", [None, 14])
def test_a_segmented_upload_gives_all_segments(siderostat, announced):
    assert upload(siderostat, segments=2, announced=announced) == b"chatterchatter"


@pytest.mark.parametrize(
    ("drive", "complaint"),
    [
        ({}, "at most 4096 bytes .* and more"),
        ({"announced": 14}, "expected 14 bytes .* 21 bytes and more"),
        ({"segments": 1, "announced": 14}, "expected 14 bytes .* 7 bytes"),
    ],
    ids=["endless", "longer than announced", "shorter than announced"],
)
def test_an_upload_of_wrong_length_is_no_object(siderostat, drive, complaint):
    def fails():
        with pytest.raises(DeviceProtocolError, match=complaint):
            upload(siderostat, **drive)
        return True

    assert within(8.0, fails)


def test_an_upload_has_one_time_limit_for_all_its_segments(siderostat):
    def fails():
        with pytest.raises(DeviceTimeout, match=r"SDO 1008:00 within 0\.1 s"):
            upload(siderostat, response_timeout_s=0.1, delay_s=0.02)
        return True

    assert within(5.0, fails)


class StallingComputer:
    """A link whose computer stands still for longer than any time limit, while the answer comes."""

    endpoint = Endpoint("drive", "nowhere")
    _answer = None

    def send(self, frame):
        self._answer = bytes.fromhex("43 0010 00 92010200")

    def receive(self, timeout_s):
        if timeout_s > 0:
            time.sleep(timeout_s + 0.01)
            return None
        answer, self._answer = self._answer, None
        return (protocol.SDO_RESPONSE_BASE + 1, answer) if answer else None


def test_an_answer_that_came_while_the_computer_stood_still_is_in_time(siderostat):
    device = siderostat.device.model_copy(update={"response_timeout_s": 0.02})
    assert Node(StallingComputer(), device).read(protocol.DEVICE_TYPE, 0, "I") == 0x20192
