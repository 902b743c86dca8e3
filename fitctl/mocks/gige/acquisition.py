"""Exposures on an absolute schedule, and their way through the frame grabber onto the wire."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Leader, Status, StreamHeader
from fitctl.mocks.gige.timer import AbsoluteTimer

KEPT_FRAMES = 8
LATE_S = 0.002


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """What the registers said when the acquisition was started."""

    destination: tuple[str, int]
    packet_size_bytes: int
    width_px: int
    height_px: int
    offset_x_px: int
    offset_y_px: int
    exposure_s: float
    frame_rate_hz: float


class _InFlight(NamedTuple):
    due_s: float
    block_id: int
    packets: list[bytes]


class Acquisition:
    """Exposes, holds each frame for the frame grabber's delay, and sends it.

    Exposure k starts at t0 + k / rate. The scene is asked for the middle of the exposure once that
    has passed; the frame leaves `frame_delay_s` after it. A process that was held up sends all that
    is due when it wakes: frames come late, and none is left out.

    Parameters
    ----------
    render : callable
        The uint16 image of a host monotonic time.
    ticks : callable
        The camera's clock at a host monotonic time.
    frame_delay_s : float
        From mid-exposure until the frame leaves.

    Attributes
    ----------
    lose : callable or None
        ``lose(block_id, packet_id)`` says which packets the network loses; resent ones are asked about too.
    frames_sent, late_frames : int
        Frames, and how many left more than 2 ms after their time.
    worst_late_s : float
        By how much the latest one was late.
    """

    def __init__(
        self,
        render: Callable[[float], NDArray[np.uint16]],
        ticks: Callable[[float], int],
        frame_delay_s: float,
    ) -> None:
        self.lose: Callable[[int, int], bool] | None = None
        self.frames_sent = 0
        self.late_frames = 0
        self.worst_late_s = 0.0
        self._render = render
        self._ticks = ticks
        self._delay_s = frame_delay_s
        self._settings: StreamSettings | None = None
        self._start_s = 0.0
        self._exposures = 0
        self._block_id = 0
        self._in_flight: deque[_InFlight] = deque()
        self._kept: OrderedDict[int, list[bytes]] = OrderedDict()
        self._timer = AbsoluteTimer(self._advance)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(("127.0.0.1", 0))

    @property
    def source_port(self) -> int:
        """The UDP port that the stream comes from."""
        return int(self._socket.getsockname()[1])

    @property
    def running(self) -> bool:
        """Whether frames are being taken."""
        return self._settings is not None

    def start(self, settings: StreamSettings) -> None:
        """Begin the first exposure now; block ids start at 1 again."""
        self.stop()
        self._settings = settings
        self._start_s = time.monotonic()
        self._exposures = 0
        self._block_id = 0
        self._arm(settings)

    def stop(self) -> None:
        """Take no more frames, and drop those that have not left."""
        self._settings = None
        self._in_flight.clear()
        self._kept.clear()
        self._timer.disarm()

    def close(self) -> None:
        """Stop and give back socket and timer; safe to call twice."""
        if self._settings is not None:
            self.stop()
        self._timer.close()
        self._socket.close()

    def send_test_packet(self, destination: tuple[str, int], packet_size_bytes: int) -> None:
        """Send the packet by which a client finds out whether this size passes the network."""
        self._transmit(
            b"\0" * (packet_size_bytes - protocol.TEST_PACKET_OVERHEAD_BYTES), destination
        )

    def resend(self, request: protocol.Resend) -> None:
        """Send packets of a kept frame again, or say that they are gone."""
        if self._settings is None:
            return
        packets = self._kept.get(request.block_id)
        if packets is None or not request.first <= request.last < len(packets):
            header = StreamHeader(
                Status.PACKET_UNAVAILABLE,
                request.block_id,
                protocol.FORMAT_PAYLOAD,
                request.first,
            )
            self._transmit(protocol.encode_stream_header(header), self._settings.destination)
            return
        again = Status.PACKET_RESEND.to_bytes(2, "big")
        for packet_id in range(request.first, request.last + 1):
            self._send(request.block_id, packet_id, again + packets[packet_id][2:], self._settings)

    def _advance(self) -> None:
        settings = self._settings
        if settings is None:
            return
        now_s = time.monotonic()
        while (middle_s := self._next_middle_s(settings)) <= now_s:
            self._expose(settings, middle_s)
        while self._in_flight and self._in_flight[0].due_s <= now_s:
            self._emit(settings, self._in_flight.popleft())
        self._arm(settings)

    def _arm(self, settings: StreamSettings) -> None:
        next_s = self._next_middle_s(settings)
        if self._in_flight:
            next_s = min(next_s, self._in_flight[0].due_s)
        self._timer.arm(next_s)

    def _next_middle_s(self, settings: StreamSettings) -> float:
        start_s = self._start_s + self._exposures / settings.frame_rate_hz
        return start_s + 0.5 * settings.exposure_s

    def _expose(self, settings: StreamSettings, middle_s: float) -> None:
        self._exposures += 1
        self._block_id = protocol.next_block(self._block_id)
        x_px, y_px = settings.offset_x_px, settings.offset_y_px
        image = self._render(middle_s)
        image = image[y_px : y_px + settings.height_px, x_px : x_px + settings.width_px]
        ticks = self._ticks(middle_s - 0.5 * settings.exposure_s)
        packets = frame_packets(self._block_id, ticks, image, settings)
        self._in_flight.append(_InFlight(middle_s + self._delay_s, self._block_id, packets))

    def _emit(self, settings: StreamSettings, frame: _InFlight) -> None:
        late_s = time.monotonic() - frame.due_s
        self.worst_late_s = max(self.worst_late_s, late_s)
        self.late_frames += late_s > LATE_S
        self._kept[frame.block_id] = frame.packets
        if len(self._kept) > KEPT_FRAMES:
            self._kept.popitem(last=False)
        for packet_id, packet in enumerate(frame.packets):
            self._send(frame.block_id, packet_id, packet, settings)
        self.frames_sent += 1

    def _send(self, block_id: int, packet_id: int, packet: bytes, settings: StreamSettings) -> None:
        if self.lose is None or not self.lose(block_id, packet_id):
            self._transmit(packet, settings.destination)

    def _transmit(self, packet: bytes, destination: tuple[str, int]) -> None:
        if destination[1] == 0:
            return  # the stream channel is closed
        with contextlib.suppress(OSError):  # a full buffer loses packets on a real network as well
            self._socket.sendto(packet, destination)


def frame_packets(
    block_id: int, ticks: int, image: NDArray[np.uint16], settings: StreamSettings
) -> list[bytes]:
    """All packets of one frame: leader, pixels, trailer; the index is the packet id."""
    height_px, width_px = image.shape
    leader = Leader(
        ticks,
        protocol.PIXEL_FORMAT_MONO16,
        width_px,
        height_px,
        settings.offset_x_px,
        settings.offset_y_px,
    )
    pixels = image.astype("<u2", copy=False).tobytes()
    chunk = settings.packet_size_bytes - protocol.PACKET_OVERHEAD_BYTES
    parts = [(protocol.FORMAT_LEADER, protocol.encode_leader(leader))]
    parts += [
        (protocol.FORMAT_PAYLOAD, pixels[start : start + chunk])
        for start in range(0, len(pixels), chunk)
    ]
    parts.append((protocol.FORMAT_TRAILER, protocol.encode_trailer(height_px)))
    return [
        protocol.encode_stream_header(StreamHeader(Status.SUCCESS, block_id, kind, packet_id))
        + payload
        for packet_id, (kind, payload) in enumerate(parts)
    ]
