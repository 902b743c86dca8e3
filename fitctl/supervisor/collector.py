"""The collector's hexapod: opened, referenced and moved beside the ticks, and stopped at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from fitctl.clock import Clock
from fitctl.config import Collector, CollectorMotion, ConfigError
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceIdentity,
    DeviceRefused,
    Hexapod,
)
from fitctl.logging.records import HEXAPOD, Severity
from fitctl.messages.commands import MoveCollector
from fitctl.messages.telemetry import CollectorState
from fitctl.model.collector_motion import beyond, course_of
from fitctl.stages.collector import CollectorDrive
from fitctl.stages.journal import error_text

_STOPPED_FIRST = "nothing began to move: a stop came first; start it again when it may move"
_CLOSE_TIMEOUT_S = 5.0
_STILL_CONNECTED = (DeviceRefused, DeviceFault, ConfigError)  # the others end the connection


class CollectorWatch:
    """Moves the collector on command; the hexapod is connected when it is first needed.

    Nothing here waits for the hexapod in the caller's thread while the drive has one of its own.

    Parameters
    ----------
    collector : Collector
    hexapod : Hexapod
    clock : Clock
    report : callable
        Records an event, from any thread: severity, source, message.

    Attributes
    ----------
    drive : CollectorDrive
        To be run at its own pace.
    identity : DeviceIdentity or None
        Who answered when it was opened.
    is_open : bool
    error : str
        What went wrong last; empty since something went well.
    """

    def __init__(
        self,
        collector: Collector,
        hexapod: Hexapod,
        clock: Clock,
        report: Callable[[Severity, str, str], None],
    ) -> None:
        self.drive = CollectorDrive(collector, hexapod, clock, seed=0)
        self.identity: DeviceIdentity | None = None
        self.is_open = False
        self.error = ""
        self.endpoint = collector.hexapod.endpoint
        self._collector = collector
        self._hexapod = hexapod
        self._report = report
        self._busy = False
        self._stops = 0
        self._stopping = 0
        self._lock = threading.Lock()  # a stop may come from two threads at once
        self._fault: Exception | None = None
        self._threads: list[threading.Thread] = []

    def obey(self, command: MoveCollector) -> str:
        """Begin what a command asks for; returns why not, or nothing. An event reports how it ends."""
        if command.motion and command.action != "start":
            return f"{command.action} has no motion; {', '.join(command.motion)} belong to start"
        if command.action == "stop":
            self.stop()
            return ""
        if occupied := self._occupied():
            return occupied
        try:
            motion = self._wanted(command.motion) if command.action == "start" else None
        except ConfigError as error:
            return f"no such motion: {error}"
        self._busy = True
        self._beside(partial(self._work, motion, self._stops))
        return ""

    def _wanted(self, values: Mapping[str, Any]) -> CollectorMotion:
        """The rig's motion with these values; ConfigError if it is none that the hexapod can ever make."""
        motion = self._collector.motion.changed(values)
        # A file is read beside the ticks, and where the hexapod stands is compared there.
        if motion.kind != "file" and (problems := beyond(course_of(motion, 0), self._collector)):
            raise ConfigError("; ".join(problems))
        return motion

    def _occupied(self) -> str:
        """Why nothing can begin now, or nothing."""
        if self._busy:
            return "the hexapod is being opened or referenced; wait for the event that reports it"
        if self._stopping:  # whose last word would stop the new motion
            return "the hexapod is being stopped; wait until it has stopped"
        return "the collector moves; stop it first" if self.drive.running else ""

    def stop(self) -> None:
        """Stop the hexapod where it is, at once; from any thread. A start that is under way ends too."""
        with self._lock:
            self._stops += 1
            connected = self.is_open
            self._stopping += connected
        if connected:
            self._beside(self._stop_at_once)

    def check(self) -> None:
        """Report a course that has ended by itself."""
        fault = self.drive.fault
        if fault is not self._fault:
            self._fault = fault
            if fault is not None:
                self._failed(fault)

    @property
    def detail(self) -> str:
        """What it does, for people."""
        if self.drive.running:
            az_mm, el_mm = self.drive.displacement_mm()
            return f"{self.drive.kind} at {az_mm:+.2f} {el_mm:+.2f} mm"
        return self.error or "stands still"

    @property
    def state(self) -> CollectorState:
        """As telemetry has it."""
        az_mm, el_mm = self.drive.displacement_mm()
        running = self.drive.running
        return CollectorState(
            busy=self._busy or any(thread.is_alive() for thread in self._threads),
            motion=self.drive.kind if running else "",
            az_mm=az_mm,
            el_mm=el_mm,
            error=self.error,
        )

    def close(self) -> None:
        """Stop what moves, and disconnect; waits for that."""
        self.stop()
        for thread in self._threads:
            thread.join(_CLOSE_TIMEOUT_S)
        self.is_open = False
        self._hexapod.close()

    def _work(self, motion: CollectorMotion | None, stops: int) -> None:
        """Begin a motion, or without one reference the hexapod; at its end, the next motion can begin."""
        try:
            try:
                severity, message = self._begin(motion, stops)
            finally:
                self._busy = False
        except (DeviceError, ConfigError) as error:
            self._failed(error)
        else:
            self._report(severity, HEXAPOD, message)

    def _begin(self, motion: CollectorMotion | None, stops: int) -> tuple[Severity, str]:
        if not self.is_open:
            self.identity = self._hexapod.open()
            self.is_open = True
        if stops != self._stops:
            return "warning", _STOPPED_FIRST
        if motion is None:
            self._hexapod.reference(lambda: stops == self._stops)
            self.error = ""
            return "info", "referenced: all axes are at zero"
        self.drive.start(motion)
        if stops != self._stops:  # a stop has the last word
            self.drive.stop()
            return "warning", _STOPPED_FIRST
        self.error = ""
        return "info", f"the collector begins to move: {motion.kind}"

    def _stop_at_once(self) -> None:
        try:
            self._stop()
        finally:
            with self._lock:
                self._stopping -= 1

    def _stop(self) -> None:
        moved = self.drive.running
        try:
            self.drive.stop()
        except DeviceError as error:
            self._failed(error)
        else:
            if moved:
                self.error = ""
                self._report("info", HEXAPOD, "the collector was stopped where it is")

    def _failed(self, error: Exception) -> None:
        self.error = error_text(error, ConfigError)
        if not isinstance(error, _STILL_CONNECTED):
            self.is_open = False
            self._hexapod.close()
        self._report("error", HEXAPOD, self.error)

    def _beside(self, work: Callable[[], None]) -> None:
        """In a thread of its own, unless nothing is threaded: a simulation, whose clock would go on."""
        if self.drive.threaded:
            thread = threading.Thread(target=work, name="collector", daemon=True)
            with self._lock:
                self._threads = [one for one in self._threads if one.is_alive()] + [thread]
                thread.start()
        else:
            work()
