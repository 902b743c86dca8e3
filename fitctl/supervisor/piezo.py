"""The piezo amplifier between ticks: what it measures, and whether that is what the D/A was sent."""

from __future__ import annotations

from concurrent.futures import Executor, Future

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Mdt693Device
from fitctl.drivers.interface import DeviceMismatch, PiezoAmplifier
from fitctl.logging.records import PiezoReading
from fitctl.loop.stellar import StellarLoop
from fitctl.stages.journal import Journal, error_text

Floats = NDArray[np.float64]


class PiezoWatch:
    """Has one loop's piezo amplifier asked now and then, and evaluates what it answers.

    Parameters
    ----------
    loop : StellarLoop
    piezo : PiezoAmplifier
    executor : Executor
        Asks it: that takes longer than a tick.
    journal : Journal

    Attributes
    ----------
    is_open : bool
        It was opened and checked, and not closed since; it is asked as long, whatever the D/A does.
    error : str
        What was wrong the last time; empty if nothing was.
    """

    def __init__(
        self,
        loop: StellarLoop,
        piezo: PiezoAmplifier,
        executor: Executor,
        journal: Journal,
    ) -> None:
        self.is_open = False
        self.error = ""
        self._loop = loop
        self._settings = loop.settings.fsm.piezo
        self._piezo = piezo
        self._clock = journal.clock
        self._executor = executor
        self._journal = journal
        self._asked_s = 0.0
        self._answer: Future[PiezoReading] | None = None

    def begin(self) -> None:
        """It was opened and checked just now."""
        self.is_open, self.error = True, ""
        self._asked_s = self._clock.now_s()

    def forget(self) -> None:
        """It is closed or opened anew: an answer that is still to come says nothing about it then."""
        self.is_open, self._answer = False, None

    def ask(self) -> None:
        """Ask, if it is open and it is time to."""
        if not self.is_open or self._answer is not None:
            return
        now_s = self._clock.now_s()
        if now_s >= self._asked_s + self._settings.poll_s:
            self._asked_s = now_s
            self._answer = self._executor.submit(
                read_piezo, self._piezo, self._loop.name, self._clock
            )

    def collect(self) -> None:
        """Evaluate its answer, if it has come."""
        answer = self._answer
        if answer is None or not answer.done():
            return
        self._answer = None
        self.evaluate(answer)

    def evaluate(self, answer: Future[PiezoReading]) -> None:
        """Evaluate an answer: SAFE where a stack is not as commanded, or at the second bad answer."""
        error, commanded_v = answer.exception(), self._loop.mirror.drain_commanded_range()
        if error is None:
            reading = answer.result()
            self._loop.quantities.record_piezo(reading)
            self._journal.record(reading)
            # Where the outputs of a D/A are that failed, nobody knows.
            if self._loop.mirror.ready:
                error = disagreement(reading, self._settings, *commanded_v)
        else:
            self._journal.failure(self._loop.name, "piezo", error)
        before, self.error = self.error, "" if error is None else error_text(error)
        if error is None:
            return
        if before or isinstance(error, DeviceMismatch):
            self._loop.fail("piezo", self.error)
        else:  # on a line without checksum one bad answer says little
            self._journal.event("warning", self._loop.name, f"{self.error}; asking again")
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
    """What was measured, where it is not what the D/A was sent since the last reading.

    Parameters
    ----------
    reading : PiezoReading
    settings : Mdt693Device
    lowest_v, highest_v : arrays, shape (3,)
        The range of what the D/A was sent, at the D/A.

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
                "commanded to the D/A",
                f"{volts:.1f} V",
                "check the cable from D/A to amplifier, the amplifier's own set-point (it must be 0 V), "
                "the stack, and piezo.gain in the rig file",
            )
    return None
