"""The camera as the loops share it: its next frame, and whether frames come."""

from __future__ import annotations

from collections.abc import Callable

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import CameraCounts, CameraDriver, DeviceError, Frame

_SILENT_FRAMES = 10  # fewer may be missing when the machine stands still
_MOST_OLDER = 1000  # frames of a stall; a camera that sends faster than we receive has no newest


class CameraWatch:
    """Waits for frames while the camera is open.

    Parameters
    ----------
    rig : Rig
    camera : CameraDriver
    clock : Clock
    failed : callable
        Takes the camera's error; no frame is asked for after that until :meth:`begin`.

    Attributes
    ----------
    ready : bool
        Frames may be asked for.
    older : list of Frame
        That came with the newest frame: it is acted on, they are not.
    skipped : int
        How many those were, since the camera was opened.
    """

    def __init__(
        self, rig: Rig, camera: CameraDriver, clock: Clock, failed: Callable[[DeviceError], None]
    ) -> None:
        self.ready = False
        self.older: list[Frame] = []
        self.skipped = 0
        self._opened = 0
        self._period_s = rig.camera.period_s
        self._silent_after_s = rig.camera.frame_delay_s + _SILENT_FRAMES * self._period_s
        self._camera = camera
        self._clock = clock
        self._failed = failed
        self._last_frame_s = clock.now_s()

    def begin(self) -> None:
        """It was opened just now."""
        self.ready = True
        self.skipped = 0
        self._opened += 1
        self._last_frame_s = self._clock.now_s()

    def next_frame(self, meanwhile: Callable[[], float]) -> Frame | None:
        """Wait for the next frame, at most two frame periods; after a stall, return the newest frame.

        Calls `meanwhile` at first, and then at each time that it returns, until the frame comes.
        """
        self.older.clear()
        if not self.ready:
            self._clock.sleep_until(self._clock.now_s() + self._period_s)
            return None
        frame = None
        try:
            frame = self._first_frame(meanwhile)
            while frame is not None and len(self.older) < _MOST_OLDER:
                newer = self._camera.next_frame(0.0)
                if newer is None:
                    break
                self.older.append(frame)
                frame = newer
        except DeviceError as error:
            if frame is not None:
                self.older.append(frame)
            self._failed(error)
            return None
        if frame is not None:
            self.skipped += len(self.older)
            self._last_frame_s = self._clock.now_s()
        return frame

    def _first_frame(self, meanwhile: Callable[[], float]) -> Frame | None:
        left_s = 2 * self._period_s
        until_s = self._clock.now_s() + left_s
        while True:
            due_s, now_s = meanwhile(), self._clock.now_s()
            if due_s - now_s >= left_s:
                return self._camera.next_frame(left_s)
            frame = self._camera.next_frame(max(0.0, due_s - now_s))
            if frame is not None:
                return frame
            left_s = max(0.0, until_s - self._clock.now_s())

    @property
    def opening(self) -> int | None:
        """How often it was opened, if frames may be asked for."""
        return self._opened if self.ready else None

    @property
    def well(self) -> bool:
        """It is open, and frames come."""
        return self.ready and self._clock.now_s() - self._last_frame_s <= self._silent_after_s

    @property
    def counts(self) -> CameraCounts:
        """Frames and losses since it was opened."""
        return self._camera.counts()
