"""The camera as the loops share it: its next frame, and whether frames come."""

from __future__ import annotations

from collections.abc import Callable

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import CameraCounts, CameraDriver, DeviceError, Frame

_SILENT_FRAMES = 10  # fewer may be missing when the machine stands still


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
    """

    def __init__(
        self, rig: Rig, camera: CameraDriver, clock: Clock, failed: Callable[[DeviceError], None]
    ) -> None:
        self.ready = False
        self._period_s = rig.camera.period_s
        self._silent_after_s = rig.camera.frame_delay_s + _SILENT_FRAMES * self._period_s
        self._camera = camera
        self._clock = clock
        self._failed = failed
        self._last_frame_s = clock.now_s()

    def begin(self) -> None:
        """It was opened just now."""
        self.ready = True
        self._last_frame_s = self._clock.now_s()

    def next_frame(self) -> Frame | None:
        """Wait for it, no longer than two frame periods."""
        if not self.ready:
            self._clock.sleep_until(self._clock.now_s() + self._period_s)
            return None
        try:
            frame = self._camera.next_frame(2 * self._period_s)
        except DeviceError as error:
            self.ready = False
            self._failed(error)
            return None
        if frame is not None:
            self._last_frame_s = self._clock.now_s()
        return frame

    @property
    def well(self) -> bool:
        """It is open, and frames come."""
        return self.ready and self._clock.now_s() - self._last_frame_s <= self._silent_after_s

    @property
    def counts(self) -> CameraCounts:
        """Frames and losses since it was opened."""
        return self._camera.counts()
