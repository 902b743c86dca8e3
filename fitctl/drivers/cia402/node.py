"""One CANopen node as its master sees it: SDO, NMT, heartbeats both ways, EMCY.

Everything runs on the caller's thread. That is why this is not python `canopen`: its SDO client waits for
a Notifier thread, and a second thread must not run beside a 500 Hz servo; it also neither sends nor
watches a heartbeat while it waits, and both must go on while the motors have current.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable

from fitctl.clock import Watchdog
from fitctl.config import Cia402Device
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.bus import BusLink
from fitctl.drivers.cia402.link import CanLink
from fitctl.drivers.cia402.protocol import NmtCommand, NmtState
from fitctl.drivers.interface import (
    DeviceFault,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
)

_MISSED_HEARTBEATS = 3
_DRAIN_FRAMES = 100  # more than a full 1 Mbit/s bus carries in five periods of a 500 Hz servo
_LONGEST_UPLOAD = 4096


class Node:
    """The drive's services.

    Parameters
    ----------
    link : CanLink or BusLink
        The open bus, or this node's part of it.
    device : Cia402Device
        Node id and time limits.

    Attributes
    ----------
    handlers : dict
        The handler of each identifier's data; the owner of a PDO adds its own.
    error_code : int
        Of the newest emergency message; 0 once the node reports that the error is gone.
    """

    def __init__(self, link: CanLink | BusLink, device: Cia402Device) -> None:
        self.link = link
        self.endpoint = link.endpoint
        self.error_code = 0
        self.nmt_state: int | None = None
        self.handlers: dict[int, Callable[[bytes], None]] = {
            protocol.HEARTBEAT_BASE + device.node_id: self._on_heartbeat,
            protocol.EMCY_BASE + device.node_id: self._on_emcy,
            protocol.SDO_RESPONSE_BASE + device.node_id: self._on_sdo,
        }
        self._device = device
        heartbeat_s = device.drive_heartbeat_s
        self._heartbeats = Watchdog(_MISSED_HEARTBEATS * heartbeat_s, heartbeat_s, time.monotonic())
        self._answer: bytes | None = None
        self._guarded = False
        self._beat_period_s = device.master_heartbeat_timeout_s / 3
        self._next_beat_s = 0.0

    def close(self) -> None:
        """Leave the bus; never raises."""
        self.link.close()

    # ------------------------------------------------------------ frames
    def pump(self, timeout_s: float) -> bool:
        """Receive one frame and pass it to its handler; False when none came in time."""
        frame = self.link.receive(timeout_s)
        if frame is None:
            return False
        handler = self.handlers.get(frame[0])
        if handler:
            handler(frame[1])
        return True

    def drain(self) -> None:
        """Receive what is waiting, at most 100 frames, so that a flood cannot block the caller."""
        for _ in range(_DRAIN_FRAMES):
            if not self.pump(0.0):
                return

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Receive frames and send our heartbeat until `done` or the time limit."""
        deadline_s = time.monotonic() + timeout_s
        while not done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                if timeout_s > 0:
                    self.drain()  # what came while the computer stood still is in time
                return done()
            self.beat()
            self.pump(min(left_s, self._beat_period_s))
        return True

    # ------------------------------------------------------------ heartbeats and NMT
    def guard(self, *, on: bool) -> None:
        """Let the drive watch our heartbeat, or not; it stops by itself when it misses ours."""
        timeout_ms = round(self._device.master_heartbeat_timeout_s * 1e3) if on else 0
        entry = self._master_id << 16 | timeout_ms
        self._guarded = False
        self.write(protocol.HEARTBEAT_CONSUMER, 1, "I", entry if on else 0)
        self._guarded = on
        self._next_beat_s = 0.0
        self.beat()

    def beat(self) -> None:
        """Send our heartbeat if it is due."""
        now_s = time.monotonic()
        if self._guarded and now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self._beat_period_s
            state = bytes([NmtState.OPERATIONAL])
            self.link.send((protocol.HEARTBEAT_BASE + self._master_id, state))

    def check_alive(self) -> None:
        """Check that the drive's heartbeat continues and reports OPERATIONAL.

        Raises
        ------
        DeviceTimeout
            If it is missing.
        DeviceFault
            If the drive has left OPERATIONAL: it restarted, or another master took it.
        """
        now_s = time.monotonic()
        if self._heartbeats.expired(now_s):
            raise self.endpoint.error(
                DeviceTimeout,
                f"the drive's heartbeat within {self._heartbeats.limit_s:g} s",
                f"none for {self._heartbeats.silent_s(now_s):.2f} s",
                "check the drive's power and its bus cable, then recover",
            )
        if self.nmt_state != NmtState.OPERATIONAL:
            raise self.endpoint.error(
                DeviceFault,
                "the drive in NMT state operational",
                f"NMT state 0x{self.nmt_state or 0:02X}",
                "it restarted, or another CANopen master commands it; recover",
            )

    def command(self, command: NmtCommand) -> None:
        """Send an NMT command to this node."""
        self.link.send((protocol.NMT_ID, bytes([command, self._device.node_id])))

    def start(self) -> None:
        """Start the node, and wait for a heartbeat that reports it.

        Raises
        ------
        DeviceTimeout
            If none comes.
        """
        self.drain()
        self.nmt_state = None
        self.command(NmtCommand.START)
        timeout_s = self._device.response_timeout_s + self._device.drive_heartbeat_s
        if not self.pump_until(lambda: self.nmt_state == NmtState.OPERATIONAL, timeout_s):
            raise self.endpoint.error(
                DeviceTimeout,
                f"a heartbeat in state operational within {timeout_s:g} s",
                "none",
                "check object 1017 and that no other master commands this drive",
            )

    # ------------------------------------------------------------ SDO
    def read(self, index: int, subindex: int, code: str) -> int:
        """An integer object; `code` is its `struct` code."""
        data = self.upload(index, subindex)
        size = struct.calcsize("<" + code)
        if len(data) < size:
            expected = f"{size} bytes of {index:04X}:{subindex:02X}"
            raise self.endpoint.error(DeviceProtocolError, expected, f"{len(data)}")
        (value,) = struct.unpack_from("<" + code, data)
        return int(value)

    def write(self, index: int, subindex: int, code: str, value: int) -> None:
        """Set an integer object of up to four bytes."""
        data = struct.pack("<" + code, value)
        command = protocol.expedited_command(protocol.SDO_DOWNLOAD, len(data))
        what = f"{index:04X}:{subindex:02X} = 0x{value & 0xFFFFFFFF:X}"
        answer = self._request(protocol.encode_sdo(command, index, subindex, data), what)
        self._expect(answer, protocol.SDO_DOWNLOADED, what)

    def text(self, index: int) -> str:
        """A text object; empty if the drive does not have it, which CiA 301 allows."""
        try:
            return self.upload(index, 0).rstrip(b"\0").decode("ascii", "replace")
        except DeviceRefused:
            return ""

    def upload(self, index: int, subindex: int) -> bytes:
        """An object's bytes, by an expedited or a segmented upload.

        Raises
        ------
        DeviceTimeout, DeviceRefused, DeviceProtocolError
            Not complete within `response_timeout_s`; an SDO abort; an answer that is none, is longer
            than 4 KiB or not as long as announced.
        """
        what = f"{index:04X}:{subindex:02X}"
        deadline_s = time.monotonic() + self._device.response_timeout_s
        answer = self._request(protocol.encode_sdo(protocol.SDO_UPLOAD, index, subindex), what)
        self._expect(answer, protocol.SDO_UPLOAD, what)
        frame = protocol.decode_sdo(answer)
        if frame.command & protocol.SDO_EXPEDITED:
            return protocol.expedited_data(frame)
        size = protocol.announced_size(frame)
        limit = _LONGEST_UPLOAD if size is None else min(size, _LONGEST_UPLOAD)
        data, toggle, last = b"", 0, False
        while not last and len(data) <= limit:
            request = protocol.encode_sdo(protocol.SDO_UPLOAD_SEGMENT | toggle, 0, 0)
            answer = self._request(request, what, deadline_s=deadline_s)
            self._expect(answer, toggle, what, mask=protocol.SDO_SPECIFIER | protocol.SDO_TOGGLE)
            chunk, last = protocol.decode_segment(answer)
            data += chunk
            toggle ^= protocol.SDO_TOGGLE
        if len(data) > limit or (size is not None and len(data) != size):
            expected = (
                f"at most {limit} bytes of {what}" if size is None else f"{size} bytes of {what}"
            )
            got = f"{len(data)} bytes" + ("" if last else " and more")
            raise self.endpoint.error(DeviceProtocolError, expected, got)
        return data

    @property
    def _master_id(self) -> int:
        return protocol.master_node_id(self._device.node_id)

    def _request(self, request: bytes, what: str, *, deadline_s: float | None = None) -> bytes:
        """One SDO round trip; late answers to earlier requests are passed over.

        `deadline_s` is given for a segment, which does not name its object.
        """
        self.drain()
        self._answer = None
        timeout_s = self._device.response_timeout_s
        segment = deadline_s is not None
        left_s = timeout_s if deadline_s is None else deadline_s - time.monotonic()
        can_id = protocol.SDO_REQUEST_BASE + self._device.node_id
        self.link.send((can_id, request))

        def answered() -> bool:
            return self._answer is not None and (segment or self._answer[1:4] == request[1:4])

        if not self.pump_until(answered, left_s):
            timed_out = struct.pack("<I", protocol.AbortCode.TIMED_OUT)
            abort = bytes([protocol.SDO_ABORT]) + request[1:4] + timed_out
            self.link.send((can_id, abort))
            raise self.endpoint.error(
                DeviceTimeout,
                f"an answer to SDO {what} within {timeout_s:g} s",
                "none",
                "check the drive's power, bit rate and node id",
            )
        answer, self._answer = self._answer, None
        return answer or b""

    def _expect(
        self, answer: bytes, service: int, what: str, *, mask: int = protocol.SDO_SPECIFIER
    ) -> None:
        if len(answer) == 8 and answer[0] == protocol.SDO_ABORT:
            (code,) = struct.unpack_from("<I", answer, 4)
            raise self.endpoint.error(
                DeviceRefused,
                f"SDO {what}",
                protocol.abort_text(code),
                "the drive does not take this setting; compare its manual with the rig file",
            )
        if len(answer) != 8 or answer[0] & mask != service:
            raise self.endpoint.error(
                DeviceProtocolError, f"an SDO answer to {what}", answer.hex(" ")
            )

    # ------------------------------------------------------------ handlers
    def _on_heartbeat(self, data: bytes) -> None:
        self._heartbeats.feed(time.monotonic())
        self.nmt_state = data[0] & 0x7F if data else None

    def _on_emcy(self, data: bytes) -> None:
        try:
            self.error_code, _ = protocol.decode_emcy(data)
        except ValueError as error:
            raise self.endpoint.error(DeviceProtocolError, "an EMCY", str(error)) from error

    def _on_sdo(self, data: bytes) -> None:
        self._answer = data
