"""Timing of ticks and servo periods, summed up once a second."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.logging.records import LoopTiming, MetrologyTick, Tick
from fitctl.stages.servo import SiderostatServo


class TimingBook:
    """Collects what each loop's ticks took and reports it.

    A servo wake-up later than ``supervisor.stall_s`` means that the machine itself stood still: the
    thread does nothing but wait for its deadline.
    """

    def __init__(self, clock: Clock, rig: Rig, record: Callable[[LoopTiming], None]) -> None:
        self._clock = clock
        self._stall_s = rig.supervisor.stall_s
        self._record = record
        self._ticks: dict[str, list[Tick | MetrologyTick]] = {name: [] for name in rig.loops}

    def add(self, tick: Tick | MetrologyTick) -> None:
        """Remember one tick until the next report; ticks without a frame have no timing."""
        if tick.number >= 0:
            self._ticks[tick.loop].append(tick)

    def report(self, servos: Mapping[str, SiderostatServo]) -> None:
        """One record for each of the given loops, for the time since the last report."""
        for name, its_servo in servos.items():
            ticks = self._ticks[name]
            servo = its_servo.drain_timing()
            compute = [tick.compute_s for tick in ticks]
            age = [tick.frame_age_s for tick in ticks]
            stalls = [late for late in servo.late_s if late > self._stall_s]
            self._record(
                LoopTiming(
                    time_s=self._clock.now_s(),
                    loop=name,
                    ticks=len(ticks),
                    late_ticks=sum(tick.late for tick in ticks),
                    frames_lost=ticks[-1].frames_lost if ticks else 0,
                    compute_median_s=_median(compute),
                    compute_worst_s=max(compute, default=math.nan),
                    frame_age_median_s=_median(age),
                    frame_age_worst_s=max(age, default=math.nan),
                    servo_periods=len(servo.late_s),
                    servo_late_median_s=_median(servo.late_s),
                    servo_late_worst_s=max(servo.late_s, default=math.nan),
                    servo_missed=servo.missed_readings,
                    stalls=len(stalls),
                    worst_stall_s=max(stalls, default=0.0),
                    servo_skipped=servo.skipped,
                )
            )
            ticks.clear()


def _median(values: list[float]) -> float:
    return statistics.median(values) if values else math.nan
