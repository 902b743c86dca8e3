"""Keeps control of the camera, and notices when it is gone."""

from __future__ import annotations

import os
import threading
import time

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.gige.ticks import CameraTime, Registers
from fitctl.drivers.interface import DeviceError, DeviceTimeout, DeviceUnreachable

PERIOD_S = 0.05  # at most; short, so that a camera that has gone is noticed at once
LATCH_PERIOD_S = 1.0


class Heartbeat:
    """A thread that refreshes the camera's heartbeat and its time until stopped or cut off.

    Parameters
    ----------
    channel : Registers
        With control of the camera.
    camera_time : CameraTime
        Refreshed about once a second.
    heartbeat_s : float
        For how long the camera keeps control without a refresh.

    Attributes
    ----------
    error : DeviceUnreachable or None
        Why the link is lost; the thread has ended then.
    wake_fd : int
        Becomes readable when the link is lost.
    """

    def __init__(self, channel: Registers, camera_time: CameraTime, heartbeat_s: float) -> None:
        self.error: DeviceUnreachable | None = None
        self.wake_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._channel = channel
        self._time = camera_time
        self._heartbeat_s = heartbeat_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gige-heartbeat", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; returns within the time of one command."""
        self._stopping.set()
        self._thread.join()
        os.close(self.wake_fd)

    def _run(self) -> None:
        period_s = min(self._heartbeat_s / 3, PERIOD_S)
        latch_due_s = time.monotonic() + LATCH_PERIOD_S
        while not self._stopping.wait(period_s):
            try:
                _check_control(self._channel)
                if self._time.runs and time.monotonic() >= latch_due_s:
                    self._time.latch()
                    latch_due_s = time.monotonic() + LATCH_PERIOD_S
            except DeviceTimeout as error:
                if time.monotonic() - self._channel.answered_s >= self._heartbeat_s:
                    return self._lose(error)
            except DeviceError as error:  # also a write refused: another program has control now
                return self._lose(error)
        return None

    def _lose(self, error: DeviceError) -> None:
        self.error = DeviceUnreachable(
            error.device, error.endpoint, error.expected, error.got, error.hint
        )
        os.eventfd_write(self.wake_fd, 1)


def _check_control(channel: Registers) -> None:
    """Read the privilege, which refreshes the heartbeat. Raises DeviceUnreachable if it is gone."""
    privilege = channel.read_register(Register.CONTROL_PRIVILEGE)
    if not privilege & (protocol.CONTROL | protocol.CONTROL_EXCLUSIVE):
        raise channel.endpoint.error(
            DeviceUnreachable,
            "to keep control of the camera",
            "a camera that has ended it",
            "the camera restarted, or fitctl's heartbeat came too late; open it again",
        )
