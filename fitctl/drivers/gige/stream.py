"""Stream packets to frames: any order within a frame, lost packets asked for again, losses counted."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import (
    GVSP_HEADER,
    PACKET_ID_MASK,
    Leader,
    MalformedPacketError,
    PixelFormat,
)
from fitctl.drivers.interface import DeviceMismatch, DeviceProtocolError

_HEADER_BYTES = GVSP_HEADER.size
_OPEN_FRAMES_MAX = 4  # more than this at once and the oldest is given up
_ASKS_MAX = 5
ASK_AGAIN_S = 0.002  # several times what a resend takes on a local network
_OLD_BLOCKS = protocol.BLOCK_IDS // 2  # a block id further ahead than this is one from the past


class CompleteFrame(NamedTuple):
    """A frame of which every packet came; `number` counts exposures since the first that was seen."""

    number: int
    leader: Leader
    image: NDArray[np.uint16]


class FrameAssembler:
    """Puts the packets of one stream together.

    A frame is complete with its leader and all pixels; the trailer adds nothing to an image of known
    height. When the trailer or a later frame's packet arrives first, the packets still missing are
    asked for, and again every `ASK_AGAIN_S`, five times at most: answers get lost as well. When a later
    frame is complete first, the frame is given up as lost.

    Parameters
    ----------
    width_px, height_px : int
        Size of the image.
    pixel_format : PixelFormat
    packet_size_bytes : int
        SCPS: one packet with all its headers.
    endpoint : Endpoint
        What errors call the camera's address.
    request_resend : callable
        Called with each run of missing packets.

    Attributes
    ----------
    frames, lost : int
        Complete frames, and frames that should have come between them.
    packets_lost : int
        Packets missing when later ones had come, healed by a resend or not. Frames of which nothing
        came are not in this count.
    """

    def __init__(
        self,
        width_px: int,
        height_px: int,
        pixel_format: PixelFormat,
        packet_size_bytes: int,
        endpoint: Endpoint,
        request_resend: Callable[[protocol.Resend], None],
    ) -> None:
        self.frames = 0
        self.lost = 0
        self.packets_lost = 0
        self._shape = (height_px, width_px)
        self._format = pixel_format
        self._chunk = packet_size_bytes - protocol.PACKET_OVERHEAD_BYTES
        image_bytes = pixel_format.bytes * height_px * width_px
        self._packets = 1 + -(-image_bytes // self._chunk)  # leader and pixels
        self._endpoint = endpoint
        self._request_resend = request_resend
        self._open: dict[int, _Block] = {}
        self._block = (
            0  # of the last complete frame, or the one before the first; 0 before any packet
        )
        # Packets of this frame, which is complete or given up, and of those before it are dropped.
        self._past = 0
        self._number = 0

    def add(self, packet: memoryview) -> CompleteFrame | None:
        """Take one packet; returns the frame that it completes.

        What is not a stream packet at all is passed over: to a frame it is the same as a lost packet.

        Raises
        ------
        DeviceMismatch
            If the camera sends another kind of image than it was set to.
        DeviceProtocolError
            If the camera uses 64-bit block ids, which it was not asked to.
        """
        if len(packet) < _HEADER_BYTES:
            return None
        status, block_id, word = GVSP_HEADER.unpack_from(packet)
        kind = word >> 24
        packet_id = word & PACKET_ID_MASK
        if kind & protocol.EXTENDED_ID_FLAG:
            raise self._endpoint.error(
                DeviceProtocolError, "16-bit block ids", "64-bit ones", "switch them off"
            )
        if block_id == 0 or protocol.is_error(status):
            return None
        if self._block == 0:
            self._block = self._past = protocol.previous_block(block_id)
        if self._is_past(block_id):
            return None
        block = self._open.get(block_id) or self._begin(block_id)
        if block is None:
            return None
        if kind == protocol.FORMAT_TRAILER:
            self._miss(block)
        elif packet_id < self._packets and not block.have[packet_id]:
            self._place(block, kind, packet_id, packet[_HEADER_BYTES:])
        return None if block.missing else self._complete(block)

    def ask_again(self) -> float | None:
        """Ask once more for what has been missing for too long.

        Returns
        -------
        float or None
            Host's monotonic time at which to call this again; None when nothing is being waited for.
        """
        now_s = time.monotonic()
        for block in self._awaited():
            if now_s >= block.ask_again_s:
                self._ask(block)
        return min((block.ask_again_s for block in self._awaited()), default=None)

    def _awaited(self) -> list[_Block]:
        return [b for b in self._open.values() if b.missing and 0 < b.asks < _ASKS_MAX]

    def _place(self, block: _Block, kind: int, packet_id: int, payload: memoryview) -> None:
        if packet_id == 0:
            if kind != protocol.FORMAT_LEADER:
                return
            block.leader = self._leader(payload)
        else:
            start = (packet_id - 1) * self._chunk
            room = block.pixels[start : start + self._chunk]
            if kind != protocol.FORMAT_PAYLOAD or len(payload) < len(room):
                return
            room[:] = payload[: len(room)]
        block.have[packet_id] = 1
        block.missing -= 1

    def _is_past(self, block_id: int) -> bool:
        ahead = protocol.blocks_between(self._past, block_id)
        return ahead == 0 or ahead > _OLD_BLOCKS

    def _begin(self, block_id: int) -> _Block | None:
        """A packet of a new frame came: what older frames still miss is late or lost."""
        for block in self._open.values():
            self._miss(block)
        if len(self._open) >= _OPEN_FRAMES_MAX:
            ids = (*self._open, block_id)
            self._past = min(ids, key=lambda one: protocol.blocks_between(self._past, one))
            if self._past == block_id:
                return None
            del self._open[self._past]
        block = _Block(block_id, self._shape, self._packets, f"<u{self._format.bytes}")
        self._open[block_id] = block
        return block

    def _miss(self, block: _Block) -> None:
        """What is missing by now was lost, or is late: count it and ask for it."""
        if block.missing and not block.asks:
            self.packets_lost += block.missing
            self._ask(block)

    def _ask(self, block: _Block) -> None:
        block.asks += 1
        block.ask_again_s = time.monotonic() + ASK_AGAIN_S
        wanted = [i for i, have in enumerate(block.have) if not have]
        for _, run in groupby(enumerate(wanted), lambda pair: pair[1] - pair[0]):
            ids = [packet_id for _, packet_id in run]
            self._request_resend(protocol.Resend(0, block.block_id, ids[0], ids[-1]))

    def _leader(self, payload: memoryview) -> Leader:
        try:
            leader = protocol.decode_leader(payload)
        except MalformedPacketError as error:
            raise self._endpoint.error(
                DeviceProtocolError, "an image", str(error), "switch off chunk data and others"
            ) from error
        height_px, width_px = self._shape
        wanted = (self._format.code, width_px, height_px)
        got = (leader.pixel_format, leader.width_px, leader.height_px)
        if got != wanted:
            raise self._endpoint.error(
                DeviceMismatch,
                "pixel format 0x{:08X}, {} x {} px".format(*wanted),
                "0x{:08X}, {} x {} px".format(*got),
                "something else has changed the camera's settings; open it again",
            )
        return leader

    def _complete(self, block: _Block) -> CompleteFrame:
        step = protocol.blocks_between(self._block, block.block_id)
        self.frames += 1
        self.lost += step - 1
        self._number += step
        self._block = self._past = block.block_id
        self._open = {i: other for i, other in self._open.items() if not self._is_past(i)}
        image = block.image.astype(np.uint16, copy=False)
        return CompleteFrame(self._number, block.leader, image)


class _Block:
    """A frame that is still being received."""

    __slots__ = (
        "ask_again_s",
        "asks",
        "block_id",
        "have",
        "image",
        "leader",
        "missing",
        "pixels",
    )

    def __init__(self, block_id: int, shape: tuple[int, int], packets: int, dtype: str) -> None:
        self.block_id = block_id
        self.leader = Leader(0, 0, 0, 0)
        self.image = np.empty(shape, np.dtype(dtype))
        self.pixels = self.image.data.cast("B")
        self.have = bytearray(packets)
        self.missing = packets
        self.asks = 0
        self.ask_again_s = 0.0
