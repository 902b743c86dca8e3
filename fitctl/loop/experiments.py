"""Test motions of the stages, open loop, and what is logged of them."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.logging.records import ExperimentStart, InjectionRecord
from fitctl.model.drives import SIDEROSTAT, Drive, channel_values, experiment_s
from fitctl.stages.journal import Journal
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Motions:
    """Under way, about where the siderostat was held."""

    drives: list[Drive]
    start_s: float
    end_s: float
    held_rad: Floats


class Experiments:
    """One loop's; at most one is under way.

    Parameters
    ----------
    loop_name : str
    motor_px_per_rad : float
    journal : Journal
    """

    def __init__(self, loop_name: str, motor_px_per_rad: float, journal: Journal) -> None:
        self._loop_name = loop_name
        self._motor_px_per_rad = motor_px_per_rad
        self._journal = journal
        self._motions: _Motions | None = None

    def begin(
        self,
        name: str,
        drives: list[Drive],
        siderostat: SiderostatStage,
        mirror: MirrorStage,
        now_s: float,
    ) -> None:
        """Make these motions, from now on."""
        held_rad = siderostat.wanted_rad
        self._motions = _Motions(drives, now_s, now_s + experiment_s(drives), held_rad)
        text = msgspec.json.encode(drives).decode()
        self._journal.record(
            ExperimentStart(time_s=now_s, loop=self._loop_name, name=name, drives_json=text)
        )
        self._report_injection(now_s, mirror.stack_v)
        mirror.injector.start(drives, now_s, mirror.stack_v)

    def setpoint_rad(self, now_s: float) -> Floats | None:
        """Where the siderostat shall be, shape (2,); None once all motions are done."""
        motions = self._motions
        if motions is None or now_s >= motions.end_s:
            return None
        offset_px = channel_values(motions.drives, SIDEROSTAT, now_s - motions.start_s)
        return motions.held_rad + offset_px / self._motor_px_per_rad

    def record_injections(self, mirror: MirrorStage) -> None:
        """Log what was written to the D/A since last asked."""
        for time_s, stack_v in mirror.drain_injections():
            self._report_injection(time_s, stack_v)

    def end(self, mirror: MirrorStage) -> Floats | None:
        """Write no more; where the siderostat was held before, shape (2,), if an experiment was under way."""
        mirror.injector.end()
        self.record_injections(mirror)
        motions, self._motions = self._motions, None
        return None if motions is None else motions.held_rad

    def _report_injection(self, time_s: float, stack_v: Floats) -> None:
        v1, v2, v3 = stack_v.tolist()
        self._journal.record(
            InjectionRecord(
                time_s=time_s, loop=self._loop_name, stack1_v=v1, stack2_v=v2, stack3_v=v3
            )
        )
