"""The stream channel: frames cut into packets, sent with their gaps, kept for those who lost some."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import OrderedDict, deque
from dataclasses import dataclass

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Leader, PixelFormat, Status, StreamHeader
from fitctl.mocks.faults import FaultKind, Faults
from fitctl.mocks.gige.datagrams import Address, Datagrams

KEPT_FRAMES = 8

STREAM_FAULTS = {
    "frame_drop": FaultKind("a frame is exposed and never sent"),
    "packet_loss": FaultKind("a packet of the stream is lost, also one that is sent again"),
    "mtu": FaultKind("larger packets of the stream are lost, headers included", "bytes", 1000.0),
}


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """The registers at the start of the acquisition."""

    destination: Address
    packet_size_bytes: int
    packet_gap_s: float
    pixel_format: PixelFormat
    width_px: int
    height_px: int
    offset_x_px: int
    offset_y_px: int


class Stream:
    """Sends frames to one destination.

    Parameters
    ----------
    faults : Faults
    resends : bool
        Whether packets are sent again on request.

    Attributes
    ----------
    frames_left_out : int
        Frames that found too many others still waiting to be sent.
    """

    def __init__(self, faults: Faults, *, resends: bool) -> None:
        self.frames_left_out = 0
        self._faults = faults
        self._resends = resends
        self._destination: Address = ("127.0.0.1", 0)
        self._gap_s = 0.0
        self._next_s = 0.0
        self._waiting: deque[bytes] = deque()
        self._kept: OrderedDict[int, list[bytes]] = OrderedDict()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(("127.0.0.1", 0))
        self._out = Datagrams(faults, self._transmit)

    @property
    def source_port(self) -> int:
        """The UDP port that it comes from."""
        return int(self._socket.getsockname()[1])

    @property
    def due_s(self) -> float:
        """Host's monotonic time of the next packet; infinite when none is waiting."""
        return self._next_s if self._waiting else float("inf")

    def open(self, destination: Address, packet_gap_s: float) -> None:
        """Send there from now on, leaving at least that time between two packets."""
        self.clear()
        self._destination = destination
        self._gap_s = packet_gap_s

    def clear(self) -> None:
        """Forget all frames."""
        self._waiting.clear()
        self._kept.clear()

    def close(self) -> None:
        """Forget all frames and give the socket back; safe to call twice."""
        self.clear()
        self._out.close()
        self._socket.close()

    def send_frame(self, block_id: int, packets: list[bytes]) -> None:
        """Send a frame as soon as those before it are out."""
        if self._faults.strikes("frame_drop"):
            return
        if len(self._waiting) >= KEPT_FRAMES * len(packets):
            self.frames_left_out += 1
            return
        self._kept[block_id] = packets
        if len(self._kept) > KEPT_FRAMES:
            self._kept.popitem(last=False)
        self._waiting.extend(packets)
        self.advance()

    def advance(self) -> None:
        """Send what is due."""
        while self._waiting and (now_s := time.monotonic()) >= self._next_s:
            self._next_s = now_s + self._gap_s
            self._send(self._waiting.popleft(), self._destination)

    def resend(self, request: protocol.Resend) -> None:
        """Send packets of a kept frame again, or say that they are gone."""
        packets = self._kept.get(request.block_id) if self._resends else None
        if packets is None or not request.first <= request.last < len(packets):
            gone = StreamHeader(
                Status.PACKET_UNAVAILABLE, request.block_id, protocol.FORMAT_PAYLOAD, request.first
            )
            self._send(protocol.encode_stream_header(gone), self._destination)
            return
        again = Status.PACKET_RESEND.to_bytes(2, "big")
        for packet in packets[request.first : request.last + 1]:
            self._send(again + packet[2:], self._destination)

    def send_test_packet(self, destination: Address, packet_size_bytes: int) -> None:
        """Send the packet by which a client finds out whether this size passes the network."""
        length = packet_size_bytes - protocol.TEST_PACKET_OVERHEAD_BYTES
        self._send(b"\0" * length, destination)

    def _send(self, packet: bytes, destination: Address) -> None:
        mtu_bytes = self._faults.value("mtu")
        size_bytes = len(packet) + protocol.TEST_PACKET_OVERHEAD_BYTES
        too_large = mtu_bytes is not None and size_bytes > mtu_bytes
        if not too_large and not self._faults.strikes("packet_loss"):
            self._out.send(packet, destination)

    def _transmit(self, packet: bytes, destination: Address) -> None:
        if destination[1] == 0:
            return  # the stream channel is closed
        with contextlib.suppress(OSError):  # a full buffer loses packets on a real network as well
            self._socket.sendto(packet, destination)


def frame_packets(
    block_id: int, ticks: int, pixels: bytes, settings: StreamSettings
) -> list[bytes]:
    """All packets of one frame: leader, pixels, trailer; the index is the packet id."""
    leader = Leader(
        ticks,
        settings.pixel_format.code,
        settings.width_px,
        settings.height_px,
        settings.offset_x_px,
        settings.offset_y_px,
    )
    chunk = settings.packet_size_bytes - protocol.PACKET_OVERHEAD_BYTES
    parts = [(protocol.FORMAT_LEADER, protocol.encode_leader(leader))]
    parts += [
        (protocol.FORMAT_PAYLOAD, pixels[start : start + chunk])
        for start in range(0, len(pixels), chunk)
    ]
    parts.append((protocol.FORMAT_TRAILER, protocol.encode_trailer(settings.height_px)))
    return [
        protocol.encode_stream_header(StreamHeader(Status.SUCCESS, block_id, kind, packet_id))
        + payload
        for packet_id, (kind, payload) in enumerate(parts)
    ]
