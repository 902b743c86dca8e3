"""An experiment's voltages on the D/A, at a pace that has no common measure with the frames'.

A command a frame would show every frame the same instant of a motion; the loop's delay, above all, could
then not be told to better than a frame.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.drivers.interface import MirrorDac
from fitctl.model.drives import FSM, STACKS, Drive, channel_values
from fitctl.model.optics import stack_matrix

Floats = NDArray[np.float64]
PERIOD_S = 0.0073
_WAIT_S = 0.1


class Injection(NamedTuple):
    """Voltages, shape (3,), and when they took effect."""

    time_s: float
    stack_v: Floats


class Injector:
    """Writes one loop's D/A while an experiment runs; idle otherwise.

    Parameters
    ----------
    dac : MirrorDac
    clock : Clock
    stack_v_per_px : array, shape (3, 2)
        Stack voltages of one pixel of mirror motion, by Eq. 1.
    bias_v, full_scale_v, slew_v_per_s : float
    """

    def __init__(
        self,
        dac: MirrorDac,
        clock: Clock,
        stack_v_per_px: Floats,
        bias_v: float,
        full_scale_v: float,
        slew_v_per_s: float,
    ) -> None:
        self.period_s = PERIOD_S
        self.threaded = False
        self.fault: Exception | None = None
        self.late_s: deque[float] = deque(maxlen=64)
        self.skipped = 0
        self._dac = dac
        self._clock = clock
        self._stack_v_per_px = stack_v_per_px
        self._bias_v = bias_v
        self._full_scale_v = full_scale_v
        self._most_slew_v = slew_v_per_s * PERIOD_S
        self._drives: list[Drive] = []
        self._start_s = 0.0
        self._off_bias_v = np.zeros(3)  # what is left of where the mirror was before
        self._running = threading.Event()
        self._turn = threading.Lock()  # one writer of the D/A at a time
        self._written: deque[Injection] = deque()

    def volts(self, drives: list[Drive], time_s: float) -> Floats:
        """What the drives ask of the stacks at a time from the experiment's start, shape (3,)."""
        return (
            self._bias_v
            + channel_values(drives, STACKS, time_s)
            + self._stack_v_per_px @ channel_values(drives, FSM, time_s)
        )

    def start(self, drives: list[Drive], start_s: float, stack_v: Floats) -> None:
        """Write from now on, with the D/A at `stack_v`, shape (3,).

        From there the mirror goes to its bias, no faster than its slew, while it makes the motions.
        """
        self._drives, self._start_s, self.fault = drives, start_s, None
        self._off_bias_v = stack_v - self._bias_v
        self._written.clear()
        self._running.set()

    def end(self) -> None:
        """Write no more; what is being written is waited for."""
        self._running.clear()
        with self._turn:
            pass

    def drain_written(self) -> list[Injection]:
        """What was written since last asked."""
        written = self._written
        return [written.popleft() for _ in range(len(written))] if written else []

    def period(self) -> None:
        """One write, if an experiment runs."""
        if not self._running.is_set():
            return
        with self._turn:
            if not self._running.is_set():
                return
            try:
                wanted = self.volts(self._drives, self._clock.now_s() - self._start_s)
                volts = np.clip(wanted + self._off_bias_v, 0.0, self._full_scale_v)
                self._dac.send_v(volts)
                self._dac.confirm()
            except Exception as error:  # else the thread would end, and nothing ever move again
                self.fault = error
                self._running.clear()
                return
            self._written.append(Injection(self._clock.now_s(), volts))
            left_v = self._off_bias_v
            self._off_bias_v = left_v - np.clip(left_v, -self._most_slew_v, self._most_slew_v)

    def wait(self) -> None:
        """Until an experiment runs, or for a while."""
        self._running.wait(_WAIT_S)


def stack_v_per_px(
    stack_radius_m: float, stack_scale_m_per_v: float, mirror_px_per_rad: float
) -> Floats:
    """Eq. 1 in pixels, shape (3, 2)."""
    return stack_matrix(stack_radius_m) / stack_scale_m_per_v / mirror_px_per_rad
