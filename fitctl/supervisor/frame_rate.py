"""Another frame rate for a while, by command or for the learner; then the rig file's again."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Protocol

from fitctl.config import Rig
from fitctl.drivers.interface import DeviceRefused
from fitctl.logging.records import CAMERA
from fitctl.stages.journal import Journal, error_text

SLOWER = (0.9, 0.98)
"""Of the rig's frame rate: between these, exposures fit, designs still hold the star, and a line moves."""
LONGEST_S = 120.0
FOR_LEARNER_S = 12.0
"""So long for the learner: designs made for the usual rate leave more of a line meanwhile;"""
PAUSE_S, MOST_PAUSE_S = 120.0, 7680.0
"""then not again for so long, and for twice as long after each further change."""
_ASKED_LATELY_S = 20.0
"""A learner's wish holds for so long: its next report comes after 30 s."""


class HasFrameRate(Protocol):
    """Of a CameraDriver, what sets the frame rate."""

    def set_frame_rate(self, rate_hz: float) -> None:
        """See :meth:`fitctl.drivers.interface.CameraDriver.set_frame_rate`."""
        ...


class FrameRateChange:
    """Has the camera run at another rate, and at the rig file's again when the time is over.

    The executor asks the camera, so that no tick waits. If the camera does not take the rig file's rate again
    within its heartbeat, it counts as failed.

    Parameters
    ----------
    rig : Rig
    camera : HasFrameRate
    opening : callable
        Which opening of the camera this is; None while no frames may be asked for.
    executor : Executor
        Runs one piece of device work after the other.
    journal : Journal
    failed : callable
        Takes the camera's error.
    """

    def __init__(
        self,
        rig: Rig,
        camera: HasFrameRate,
        opening: Callable[[], int | None],
        executor: Executor,
        journal: Journal,
        failed: Callable[[Exception], None],
    ) -> None:
        self._rate_hz = rig.camera.frame_rate_hz
        self._camera = camera
        self._opening = opening
        self._executor = executor
        self._journal = journal
        self._clock = journal.clock
        self._failed = failed
        self._job: Future[None] | None = None
        self._wanted_hz = self._rate_hz
        self._duration_s = 0.0
        self._until_s = math.inf  # since the other rate is in force
        self._patience_s = rig.camera.device.heartbeat_s
        self._back_from_s = math.inf  # since when the usual rate is being set
        self._changed: int | None = None  # at which opening of the camera
        self._learner_from_s, self._pause_s = -math.inf, PAUSE_S
        self._paused: int | None = None  # likewise, for the learner

    @property
    def active(self) -> bool:
        """The camera does not run as the rig file says, or its rate is being changed."""
        return self._changed is not None and self._changed == self._opening()

    def why_not(self, rate_hz: float, duration_s: float) -> str:
        """Why the rate cannot be changed so; empty if it can."""
        low_hz, high_hz = (part * self._rate_hz for part in SLOWER)
        if self._opening() is None:
            return "frame-rate needs an open camera; send standby first"
        if self.active:
            return f"the camera runs at {self._wanted_hz:g} Hz already; wait until it runs as usual again"
        if not low_hz <= rate_hz <= high_hz:
            return f"frame-rate must be {low_hz:g} to {high_hz:g} Hz, got {rate_hz:g}"
        if not 1.0 <= duration_s <= LONGEST_S:
            return f"duration_s must be 1 to {LONGEST_S:g}, got {duration_s:g}"
        return ""

    def begin(self, rate_hz: float, duration_s: float) -> None:
        """Change the rate, which `why_not` allows."""
        self._changed = self._opening()
        self._duration_s, self._until_s = duration_s, math.inf
        self._set(rate_hz)

    def for_learner(self, rate_hz: float, asked_s: float) -> None:
        """Change the rate for a learner that asked for it then, unless that was done lately; 0 is no rate."""
        now_s = self._clock.now_s()
        if self._paused != self._opening():
            self._paused = self._opening()
            self._learner_from_s, self._pause_s = -math.inf, PAUSE_S
        if not rate_hz or now_s - asked_s > _ASKED_LATELY_S or now_s < self._learner_from_s:
            return
        if self.why_not(rate_hz, FOR_LEARNER_S):
            return
        self._learner_from_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, MOST_PAUSE_S)
        self.begin(rate_hz, FOR_LEARNER_S)

    def end(self) -> None:
        """Let the other rate end now, if there is one."""
        self._until_s = -math.inf

    def check(self) -> None:
        """Once a frame: see what the camera has answered, and whether the time is over."""
        job = self._job
        if not self.active:
            self._job = None
        elif job is not None and job.done():
            self._job = None
            try:
                job.result()
            except Exception as error:
                self._answered(error)
            else:
                self._answered(None)
        elif job is None and self._clock.now_s() >= self._until_s:
            self._set(self._rate_hz)

    def _answered(self, error: Exception | None) -> None:
        now_hz, usual_hz = self._wanted_hz, self._rate_hz
        if now_hz == usual_hz:
            self._answered_usual(error)
        elif error is None:
            self._until_s = min(self._until_s, self._clock.now_s() + self._duration_s)
            self._journal.event("info", CAMERA, f"runs at {now_hz:g} Hz for {self._duration_s:g} s")
        elif isinstance(error, DeviceRefused):
            self._changed = None
            self._journal.event("warning", CAMERA, f"keeps its frame rate: {error_text(error)}")
        else:
            why = error_text(error)
            self._journal.event(
                "warning", CAMERA, f"may run at {now_hz:g} or {usual_hz:g} Hz: {why}"
            )
            self._set(usual_hz)

    def _answered_usual(self, error: Exception | None) -> None:
        if error is None:
            self._changed = None
            self._journal.event("info", CAMERA, f"runs at {self._rate_hz:g} Hz again")
        elif self._clock.now_s() - self._back_from_s < self._patience_s:
            self._job = self._executor.submit(self._camera.set_frame_rate, self._rate_hz)
        else:
            self._changed = None
            self._failed(error)

    def _set(self, rate_hz: float) -> None:
        self._wanted_hz, self._back_from_s = rate_hz, self._clock.now_s()
        self._job = self._executor.submit(self._camera.set_frame_rate, rate_hz)
