"""One CAN bus with several drives: one connection, one SYNC a period for all, each frame to its own drive.

One thread uses all drives, also those of other buses. While it waits for an answer of one drive, which takes
long when that drive is opened, it calls :attr:`CanBus.meanwhile`, so that the others go on being servoed.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Thread
from typing import TYPE_CHECKING, TypeVar

from fitctl.config import Cia402Device
from fitctl.drivers.amplifiers import DEVICE
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceUnreachable

if TYPE_CHECKING:
    from fitctl.drivers.cia402.link import CanLink

_SLICE_S = 0.0005  # of a wait, between two calls of `meanwhile`
_INBOX_FRAMES = 1000
_NODE_ID = 0x7F  # in an identifier of CANopen's predefined connections

_T = TypeVar("_T")


class CanBus:
    """A bus that is connected while at least one of its drives is open.

    Attributes
    ----------
    meanwhile : callable or None
        Called again and again while a drive waits for an answer, or the bus for its connection.
    """

    def __init__(self) -> None:
        self.meanwhile: Callable[[], None] | None = None
        self._link: CanLink | None = None
        self._closing: Thread | None = None
        self._drives: dict[int, BusLink] = {}

    def connect(self, device: Cia402Device) -> BusLink:
        """The link of one drive; the bus is connected if it is not.

        All drives have interface, channel and bit rate in common.

        Raises
        ------
        DeviceUnreachable
            If the bus cannot be opened.
        """
        if self._link is None:
            self._link = self._connected(device)
        address = f"{device.interface} {device.channel}, node {device.node_id}"
        link = BusLink(self, device.node_id, Endpoint(DEVICE, address))
        self._drives[device.node_id] = link
        return link

    def _connected(self, device: Cia402Device) -> CanLink:
        """A connection; connecting takes seconds where no adapter answers."""
        # Here, because python-can costs 140 ms that a command without hardware need not wait for.
        from fitctl.drivers.cia402.link import CanLink

        closing = self._closing

        def connect() -> CanLink:
            if closing is not None:
                closing.join()  # a serial port has one user
            return CanLink(device)

        return self._beside(connect)

    def _beside(self, action: Callable[[], _T]) -> _T:
        """What an action gives that waits without receiving, while the others go on being servoed."""
        meanwhile = self.meanwhile
        if meanwhile is None:
            return action()
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(action)
            while wait([running], _SLICE_S).not_done:
                meanwhile()
            return running.result()

    def leave(self, link: BusLink) -> None:
        """A drive is closed; after the last one the bus is disconnected."""
        if self._drives.get(link.node_id) is link:
            del self._drives[link.node_id]
        if not self._drives:
            connection, self._link = self._link, None
            if connection is not None:
                self._beside(connection.close)

    def pump(self, timeout_s: float) -> bool:
        """Receive one frame and pass it to the drive that sent it; False when none came in time.

        Raises
        ------
        DeviceUnreachable, DeviceProtocolError
        """
        frame = self._carried(lambda link: link.receive(timeout_s))
        if frame is None:
            return False
        drive = self._drives.get(frame[0] & _NODE_ID)
        if drive is not None:
            drive.inbox.append(frame)
        return True

    def send(self, *frames: tuple[int, bytes]) -> None:
        """Put frames on the bus in this order.

        Raises
        ------
        DeviceUnreachable
        """
        self._carried(lambda link: link.send(*frames))

    def synchronize(self) -> None:
        """Send what the drives have been given for this period, and the SYNC on which all act and latch.

        Raises
        ------
        DeviceUnreachable
        """
        frames = [drive.staged for drive in self._drives.values() if drive.staged is not None]
        if not frames:
            return
        sync_s = time.monotonic()
        for drive in self._drives.values():
            drive.staged = None
            if drive.on_sync is not None:
                drive.on_sync(sync_s)
        self.send(*frames, (protocol.SYNC_ID, b""))

    def _carried(self, action: Callable[[CanLink], _T]) -> _T:
        """What the connection gives; once it is broken, every drive finds it so until it is made anew."""
        if self._link is None:
            endpoint = next(iter(self._drives.values())).endpoint
            raise endpoint.error(
                DeviceUnreachable,
                "a connected CAN bus",
                "one whose connection broke",
                "check the adapter and its cable, then recover all loops on this bus",
            )
        try:
            return action(self._link)
        except DeviceUnreachable:
            # Beside, because pyserial waits 0.3 s when it closes a socket.
            self._closing = Thread(target=self._link.close, daemon=True)
            self._link = None
            self._closing.start()
            raise


class BusLink:
    """One drive's part of a bus; a :class:`~fitctl.drivers.cia402.link.CanLink` to its node.

    Attributes
    ----------
    node_id : int
    endpoint : Endpoint
    inbox : deque
        Frames that the drive sent and that its node has not received yet.
    staged : (int, bytes) or None
        The frame that goes out before the next SYNC.
    on_sync : callable or None
        Gets the host's monotonic time just before each SYNC on the bus.
    """

    def __init__(self, bus: CanBus, node_id: int, endpoint: Endpoint) -> None:
        self.node_id = node_id
        self.endpoint = endpoint
        self.inbox: deque[tuple[int, bytes]] = deque(maxlen=_INBOX_FRAMES)
        self.staged: tuple[int, bytes] | None = None
        self.on_sync: Callable[[float], None] | None = None
        self._bus = bus

    def send(self, *frames: tuple[int, bytes]) -> None:
        """Put frames, each an 11-bit identifier and data, on the bus in this order."""
        self._bus.send(*frames)

    def synchronize(self) -> None:
        """Send the staged frames of all drives and a SYNC, if the one of this drive is still to be sent."""
        if self.staged is not None:
            self._bus.synchronize()

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        """The next frame of this drive; None when none came in time."""
        deadline_s = time.monotonic() + timeout_s
        left_s = timeout_s
        while not self.inbox:
            meanwhile = self._bus.meanwhile
            received = self._bus.pump(left_s if meanwhile is None else min(left_s, _SLICE_S))
            if meanwhile is not None:
                meanwhile()
            left_s = max(0.0, deadline_s - time.monotonic())
            if not self.inbox and not (received or left_s):
                return None
        return self.inbox.popleft()

    def close(self) -> None:
        """Leave the bus; never raises."""
        self._bus.leave(self)
