"""The piezo amplifier between ticks: what it measures, and whether that is what it was told."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Mdt693Device
from fitctl.drivers.interface import DeviceMismatch, PiezoAmplifier
from fitctl.logging.records import AnyRecord, Event, PiezoReading
from fitctl.loop.loop import StellarLoop
from fitctl.stages.failures import error_text, failure_record

Floats = NDArray[np.float64]


class PiezoWatch:
    """Has one loop's piezo amplifier asked now and then, and judges what it answers.

    Parameters
    ----------
    loop : StellarLoop
    piezo : PiezoAmplifier
    clock : Clock
    executor : Executor
        Asks it: that takes longer than a tick.
    record : callable
        Takes readings and events; must not block.

    Attributes
    ----------
    error : str
        What was wrong the last time; empty if nothing was.
    """

    def __init__(
        self,
        loop: StellarLoop,
        piezo: PiezoAmplifier,
        clock: Clock,
        executor: Executor,
        record: Callable[[AnyRecord], None],
    ) -> None:
        self.error = ""
        self._loop = loop
        self._settings = loop.settings.fsm.piezo
        self._piezo = piezo
        self._clock = clock
        self._executor = executor
        self._record = record
        self._asked_s = 0.0
        self._answer: Future[PiezoReading] | None = None

    def begin(self) -> None:
        """It was opened and checked just now."""
        self.error = ""
        self._asked_s = self._clock.now_s()

    def forget(self) -> None:
        """It is opened anew: an answer that is still to come says nothing about it then."""
        self._answer = None

    def ask(self) -> None:
        """Ask, if it is time to."""
        now_s = self._clock.now_s()
        if self._answer is None and now_s >= self._asked_s + self._settings.poll_s:
            self._asked_s = now_s
            self._answer = self._executor.submit(
                read_piezo, self._piezo, self._loop.name, self._clock
            )

    def collect(self) -> None:
        """Take its answer, if it has come."""
        answer = self._answer
        if answer is None or not answer.done():
            return
        self._answer = None
        self.evaluate(answer)

    def evaluate(self, answer: Future[PiezoReading]) -> None:
        """Judge an answer: SAFE where a stack is not as told, or at the second bad one."""
        error, commanded_v = answer.exception(), self._loop.stages.drain_commanded_range()
        if error is None:
            reading = answer.result()
            self._loop.quantities.record_piezo(reading)
            self._record(reading)
            error = disagreement(reading, self._settings, *commanded_v)
        else:
            self._record(failure_record(self._clock.now_s(), self._loop.name, "piezo", error))
        before, self.error = self.error, "" if error is None else error_text(error)
        if error is None:
            return
        if before or isinstance(error, DeviceMismatch):
            self._loop.fail(self.error)
        else:  # on a line without checksum one bad answer says little
            self._record(
                Event(
                    time_s=self._clock.now_s(),
                    severity="warning",
                    source=self._loop.name,
                    message=f"{self.error}; asking again",
                )
            )
            self._asked_s -= self._settings.poll_s


def read_piezo(piezo: PiezoAmplifier, loop_name: str, clock: Clock) -> PiezoReading:
    """Ask for its voltages and its limit; takes as long as the wire does.

    Raises
    ------
    DeviceError
    """
    volts, limit_v = piezo.stack_volts(), piezo.limit_v()
    return PiezoReading(
        time_s=clock.now_s(),
        loop=loop_name,
        stack1_v=float(volts[0]),
        stack2_v=float(volts[1]),
        stack3_v=float(volts[2]),
        limit_v=limit_v,
    )


def disagreement(
    reading: PiezoReading, settings: Mdt693Device, lowest_v: Floats, highest_v: Floats
) -> DeviceMismatch | None:
    """What was measured, where it is not what the D/A was told since the last reading.

    Parameters
    ----------
    reading : PiezoReading
    settings : Mdt693Device
    lowest_v, highest_v : arrays, shape (3,)
        The range of what the D/A was told, at the D/A.

    Returns
    -------
    DeviceMismatch or None
        Of the first stack that is outside its range by more than `follow_tolerance_v`.
    """
    measured_v = (reading.stack1_v, reading.stack2_v, reading.stack3_v)
    commanded_v = np.clip(settings.gain * np.array([lowest_v, highest_v]), 0.0, settings.limit_v)
    tolerance_v = settings.follow_tolerance_v
    for stack, volts in enumerate(measured_v):
        low_v, high_v = commanded_v[:, stack]
        if not low_v - tolerance_v <= volts <= high_v + tolerance_v:
            return DeviceMismatch(
                "piezo amplifier",
                settings.port,
                f"stack {stack + 1} within {tolerance_v:g} V of the {low_v:.1f} to {high_v:.1f} V "
                "that the D/A was told",
                f"{volts:.1f} V",
                "check the cable from D/A to amplifier, the amplifier's own set-point (it must be 0 V), "
                "the stack, and piezo.gain in the rig file",
            )
    return None
