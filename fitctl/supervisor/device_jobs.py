"""Opening and closing devices beside the ticks: one job at a time, and what follows from how it ends."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from functools import partial
from typing import NamedTuple, Protocol

from fitctl.drivers.interface import DeviceIdentity, Devices
from fitctl.logging.records import DevicesOpened, Severity
from fitctl.loop.loop import Loop
from fitctl.messages.modes import OPERATOR, Mode, Trigger
from fitctl.stages.journal import Journal, error_text
from fitctl.supervisor.camera_watch import CameraWatch
from fitctl.supervisor.piezo import PiezoWatch
from fitctl.supervisor.power import Opened, close_devices, open_devices

_CLOSE_TIMEOUT_S = 30.0
_OPEN = "all devices open, checked and enabled"
_OFF = "OFF: amplifiers disabled, devices closed"
_STOPPED = "stopped while opening; when ready, recover, or standby from OFF"
_SOURCE = "supervisor"  # of its events


class Ended(Protocol):
    """Hears how opening or closing ended: what happened, or why it failed."""

    def __call__(self, text: str, /, *, failed: bool) -> None:
        """Hear it."""


class Job(NamedTuple):
    """Work under way, and what is to be done when it ends."""

    future: Future
    done: Callable[[Future], None]


class DeviceJobs:
    """Opens and closes the devices of some loops.

    Parameters
    ----------
    devices : Devices
    loops, piezos : mappings by loop name
    camera : CameraWatch
    executor : Executor
        Runs device work; must run one piece at a time.
    journal : Journal

    Attributes
    ----------
    identities : dict of DeviceIdentity
        By device: who answered when it was last opened.
    """

    def __init__(
        self,
        devices: Devices,
        loops: Mapping[str, Loop],
        piezos: Mapping[str, PiezoWatch],
        camera: CameraWatch,
        executor: Executor,
        journal: Journal,
    ) -> None:
        self.identities: dict[str, DeviceIdentity] = {}
        self._devices = devices
        self._loops = loops
        self._servos = {name: loop.servo for name, loop in loops.items()}
        self._piezos = piezos
        self._camera = camera
        self._executor = executor
        self._journal = journal
        self._job: Job | None = None
        self._opening: set[str] = set()
        self._abandoned = False
        self._closed_badly: deque[tuple[str, Exception]] = deque()  # filled by the executor
        self._faults: list[str] = []  # of the devices that are being closed

    @property
    def busy(self) -> bool:
        """Devices are being opened or closed."""
        return self._job is not None

    def open(self, names: list[str], trigger: Trigger, ended: Ended) -> None:
        """Open the devices of these loops, then fire `trigger` on each; `ended` once all of that is over."""
        for name in names:
            self._loops[name].release()
        self._forget_piezos(names)
        self._opening, self._abandoned = set(names), False
        self._journal.event("info", _SOURCE, "opening and checking all devices")
        with_camera = not self._camera.well
        self._camera.ready = not with_camera  # nobody asks it for frames while it is opened
        future = self._submit(open_devices, names, with_camera)
        self._job = Job(future, partial(self._opened, names, with_camera, trigger, ended))
        self.finish()

    def opens(self, name: str) -> bool:
        """The devices of this loop are being opened."""
        return name in self._opening

    def abandon(self, names: list[str]) -> None:
        """Let go of what is being opened, if it is for one of these loops: a stop has the last word."""
        self._abandoned = self._abandoned or not self._opening.isdisjoint(names)

    def turn_off(self, names: list[str], ended: Ended) -> None:
        """Close the devices of these loops for OFF, then call `ended`."""
        for name in names:
            self._loops[name].release()
            self._loops[name].fire(Trigger.OFF, OPERATOR)
        self._forget_piezos(names)
        # The camera serves all loops; the last one out turns it off.
        with_camera = all(loop.mode is Mode.OFF for loop in self._loops.values())
        self._camera.ready = self._camera.ready and not with_camera
        self._close(
            names, with_camera, lambda faults: ended("; ".join(faults) or _OFF, failed=bool(faults))
        )

    def close_all(self) -> None:
        """Disable and close all devices, from every state, and wait until this is done."""
        for loop in self._loops.values():
            loop.release()
        self._camera.ready = False
        self._forget_piezos(list(self._loops))
        self._submit(close_devices, list(self._loops), True).result(timeout=_CLOSE_TIMEOUT_S)
        self._report_closed_badly()

    def finish(self) -> None:
        """Do what follows from a job that has ended."""
        self._report_closed_badly()
        job = self._job
        if job is not None and job.future.done():
            self._job = None
            job.done(job.future)

    def _opened(
        self,
        names: list[str],
        with_camera: bool,
        trigger: Trigger,
        ended: Ended,
        future: Future,
    ) -> None:
        abandoned, self._opening, self._abandoned = self._abandoned, set(), False
        error = future.exception()
        self._log_opened(
            names, None if error else future.result(), error_text(error) if error else ""
        )
        if error is not None:
            why = error_text(error)
            self._journal.event("error", _SOURCE, f"{trigger.name.lower()} failed: {why}")
            self._close(names, with_camera, lambda _faults: ended(why, failed=True))
            return
        if abandoned:
            self._journal.event(
                "warning", _SOURCE, "stopped while opening the devices; they are closed again"
            )
            self._close(names, with_camera, lambda _faults: ended(_STOPPED, failed=True))
            return
        opened: Opened = future.result()
        self.identities.update(opened.identities)
        if with_camera:  # else it has been open all the time, or has failed meanwhile
            self._camera.begin()
        for name in names:
            loop = self._loops[name]
            loop.begin(opened.stack_v.get(name))
            if name in self._piezos:
                self._piezos[name].begin()
            # Opening imports and parses: what the servo waited meanwhile is no stall of the machine.
            self._servos[name].drain_timing()
            loop.fire(trigger, _OPEN)
        elsewhere = [name for name in names if self._loops[name].mode is not Mode.STANDBY]
        if elsewhere:
            ended(f"{', '.join(elsewhere)} went to SAFE meanwhile; send recover", failed=True)
        else:
            ended(f"STANDBY: {_OPEN}", failed=False)

    def _log_opened(self, names: list[str], opened: Opened | None, error: str) -> None:
        for name in names:
            found_v = None if opened is None else opened.stack_v.get(name)
            v1, v2, v3 = [math.nan] * 3 if found_v is None else found_v.tolist()
            self._journal.record(
                DevicesOpened(
                    time_s=self._journal.clock.now_s(),
                    loop=name,
                    stack1_v=v1,
                    stack2_v=v2,
                    stack3_v=v3,
                    encoders_jumped=self._servos[name].encoders_jumped,
                    error=error,
                )
            )

    def _close(
        self, names: list[str], with_camera: bool, done: Callable[[list[str]], None]
    ) -> None:
        """Close devices; then `done` gets what went wrong, a text each."""
        self._faults.clear()
        future = self._submit(close_devices, names, with_camera)
        self._job = Job(future, partial(self._closed, done))

    def _closed(self, done: Callable[[list[str]], None], future: Future) -> None:
        error = future.exception()
        if error is not None:
            self._note_fault("error", f"closing devices failed: {error_text(error)}")
        done(self._faults)

    def _note_fault(self, severity: Severity, text: str) -> None:
        self._faults.append(text)
        self._journal.event(severity, _SOURCE, text)

    def _submit(
        self, work: Callable[..., Opened | None], names: list[str], with_camera: bool
    ) -> Future:
        return self._executor.submit(
            work, self._devices, self._servos, names, with_camera, self._note_closed_badly
        )

    def _forget_piezos(self, names: list[str]) -> None:
        for name in names:
            if name in self._piezos:
                self._piezos[name].forget()

    def _note_closed_badly(self, device: str, error: Exception) -> None:
        self._closed_badly.append((device, error))

    def _report_closed_badly(self) -> None:
        while self._closed_badly:
            device, error = self._closed_badly.popleft()
            self._note_fault("warning", f"{device} did not close well: {error_text(error)}")
