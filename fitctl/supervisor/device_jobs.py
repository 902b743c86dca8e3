"""Opening and closing devices beside the ticks: one job at a time, and what follows from how it ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from functools import partial
from typing import NamedTuple

from fitctl.clock import Clock
from fitctl.drivers.interface import DeviceIdentity, Devices
from fitctl.logging.records import AnyRecord, DevicesOpened, Severity
from fitctl.loop.loop import StellarLoop
from fitctl.messages.modes import Mode, Trigger
from fitctl.stages.failures import error_text
from fitctl.stages.servo import SiderostatServo
from fitctl.supervisor.camera_watch import CameraWatch
from fitctl.supervisor.piezo import PiezoWatch
from fitctl.supervisor.power import Opened, close_devices, open_devices

Tell = Callable[[Severity, str, str], None]
_CLOSE_TIMEOUT_S = 30.0
_SOURCE = "supervisor"  # of its events


class Job(NamedTuple):
    """Work under way, and what is to be done when it ends."""

    future: Future
    done: Callable[[Future], None]


class DeviceJobs:
    """Opens and closes the devices of some loops.

    Parameters
    ----------
    devices : Devices
    loops, servos, piezos : mappings by loop name
    camera : CameraWatch
    clock : Clock
    executor : Executor
        Runs device work; must run one piece at a time.
    record : callable
        Takes records; must not block.
    event, note : callables
        Take events: here and now, and from any thread.

    Attributes
    ----------
    identities : dict of DeviceIdentity
        By device: who answered when it was last opened.
    """

    def __init__(
        self,
        devices: Devices,
        loops: Mapping[str, StellarLoop],
        servos: Mapping[str, SiderostatServo],
        piezos: Mapping[str, PiezoWatch],
        camera: CameraWatch,
        clock: Clock,
        executor: Executor,
        record: Callable[[AnyRecord], None],
        event: Tell,
        note: Tell,
    ) -> None:
        self.identities: dict[str, DeviceIdentity] = {}
        self._devices = devices
        self._loops = loops
        self._servos = servos
        self._piezos = piezos
        self._camera = camera
        self._clock = clock
        self._executor = executor
        self._record = record
        self._event = event
        self._note = note
        self._job: Job | None = None
        self._opening: set[str] = set()
        self._abandoned = False

    @property
    def busy(self) -> bool:
        """Devices are being opened or closed."""
        return self._job is not None

    def open(self, names: list[str], trigger: Trigger) -> None:
        """Open the devices of these loops, then fire `trigger` on each."""
        for name in names:
            self._loops[name].stages.ready = False
            self._piezos[name].forget()
        self._opening, self._abandoned = set(names), False
        self._event("info", _SOURCE, "opening and checking all devices")
        with_camera = not self._camera.well
        self._camera.ready = not with_camera  # nobody asks it for frames while it is opened
        future = self._submit(open_devices, names, with_camera)
        self._job = Job(future, partial(self._opened, names, with_camera, trigger))
        self.finish()

    def opens(self, name: str) -> bool:
        """The devices of this loop are being opened."""
        return name in self._opening

    def abandon(self, names: list[str]) -> None:
        """Let go of what is being opened, if it is for one of these loops: a stop has the last word."""
        self._abandoned = self._abandoned or not self._opening.isdisjoint(names)

    def turn_off(self, names: list[str]) -> None:
        """OFF for these loops, and their devices let go."""
        for name in names:
            self._loops[name].stages.ready = False
            self._loops[name].fire(Trigger.OFF, "operator")
        # The camera serves all loops; the last one out turns it off.
        with_camera = all(loop.mode is Mode.OFF for loop in self._loops.values())
        self._camera.ready = self._camera.ready and not with_camera
        self._close(names, with_camera)

    def close_all(self) -> None:
        """Disable and let go of everything, whatever state it is in, and wait for that."""
        for loop in self._loops.values():
            loop.stages.ready = False
        self._camera.ready = False
        self._submit(close_devices, list(self._loops), True).result(timeout=_CLOSE_TIMEOUT_S)

    def finish(self) -> None:
        """Do what follows from a job that has ended."""
        job = self._job
        if job is not None and job.future.done():
            self._job = None
            job.done(job.future)

    def _opened(
        self, names: list[str], with_camera: bool, trigger: Trigger, future: Future
    ) -> None:
        abandoned, self._opening, self._abandoned = self._abandoned, set(), False
        error = future.exception()
        self._log_opened(
            names, None if error else future.result(), error_text(error) if error else ""
        )
        if error is not None:
            self._event("error", _SOURCE, f"{trigger.name.lower()} failed: {error_text(error)}")
            self._close(names, with_camera)
            return
        if abandoned:
            self._event("warning", _SOURCE, "stopped while opening; devices let go")
            self._close(names, with_camera)
            return
        opened: Opened = future.result()
        self.identities.update(opened.identities)
        self._camera.begin()
        for name in names:
            loop = self._loops[name]
            loop.start_from(opened.stack_v[name])
            self._piezos[name].begin()
            # Opening imports and parses: what the servo waited meanwhile is no stall of the machine.
            self._servos[name].drain_timing()
            loop.fire(trigger, "all devices open, checked and enabled")

    def _log_opened(self, names: list[str], opened: Opened | None, error: str) -> None:
        for name in names:
            v1, v2, v3 = [math.nan] * 3 if opened is None else opened.stack_v[name].tolist()
            self._record(
                DevicesOpened(
                    time_s=self._clock.now_s(),
                    loop=name,
                    stack1_v=v1,
                    stack2_v=v2,
                    stack3_v=v3,
                    encoders_jumped=self._servos[name].encoders_jumped,
                    error=error,
                )
            )

    def _close(self, names: list[str], with_camera: bool) -> None:
        self._job = Job(self._submit(close_devices, names, with_camera), lambda _: None)

    def _submit(
        self, work: Callable[..., Opened | None], names: list[str], with_camera: bool
    ) -> Future:
        return self._executor.submit(
            work, self._devices, self._servos, names, with_camera, self._closed_badly
        )

    def _closed_badly(self, device: str, error: Exception) -> None:
        self._note("warning", _SOURCE, f"{device} did not close well: {error_text(error)}")
