"""What an experiment left behind: the frames' findings, and every voltage that was injected."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.identify.errors import IdentifyError
from fitctl.logging.reading import read_records
from fitctl.logging.records import AnyRecord, ExperimentStart, InjectionRecord, Tick
from fitctl.logging.schemas import TOPICS

Floats = NDArray[np.float64]
_TICK_FIELDS = tuple(field.name for field in msgspec.structs.fields(Tick))
_EXPERIMENT = "EXPERIMENT"


@dataclass(frozen=True)
class ExperimentRecord:
    """One experiment on one loop. All times are the host's monotonic clock, seconds.

    Attributes
    ----------
    loop : str
    tick : dict of str to array, shape (ticks,)
        Fields of :class:`~fitctl.logging.records.Tick`, for the ticks of the experiment; a tick without
        a star has ``star_visible`` False and NaN in ``star_az_px`` and ``star_el_px``.
        ``siderostat_az_rad`` and ``_el_rad`` are the encoders at ``mid_exposure_s``.
    injected_s : array, shape (n,)
        When each injected set of voltages took effect; it held until the next.
    injected_v : array, shape (n, 3)
        At the D/A, stack 1 to 3. The first row is what was in force when the experiment began.
    """

    loop: str
    tick: dict[str, NDArray[Any]]
    injected_s: Floats
    injected_v: Floats

    def stack_v_at(self, time_s: Floats) -> Floats:
        """Voltages in force at given times, shape (..., 3)."""
        row = np.searchsorted(self.injected_s, time_s, side="right") - 1
        return self.injected_v[np.maximum(row, 0)]

    @property
    def star_px(self) -> Floats:
        """Centroids (az, el), shape (ticks, 2); NaN without a star."""
        return np.column_stack([self.tick["star_az_px"], self.tick["star_el_px"]])

    @property
    def motor_rad(self) -> Floats:
        """Encoders at mid-exposure (az, el), shape (ticks, 2)."""
        return np.column_stack([self.tick["siderostat_az_rad"], self.tick["siderostat_el_rad"]])


class Gatherer:
    """Takes records as they come and keeps those of the last experiment of a name.

    Parameters
    ----------
    loop, name : str
    """

    def __init__(self, loop: str, name: str) -> None:
        self._loop = loop
        self._name = name
        self._begun = self._over = False
        self._ticks: list[tuple[Any, ...]] = []
        self._injected: list[tuple[float, float, float, float]] = []

    def take(self, record: Any) -> None:
        """Take one record: a struct, or a log's message with the same fields."""
        kind = type(record).__name__
        if kind not in _KINDS or record.loop != self._loop:
            return
        if kind == ExperimentStart.__name__:
            self._begun, self._over = record.name == self._name, False
            if self._begun:
                self._ticks.clear()
                self._injected.clear()
        elif not self._begun or self._over:
            return
        elif kind == InjectionRecord.__name__:
            self._injected.append(
                (record.time_s, record.stack1_v, record.stack2_v, record.stack3_v)
            )
        elif record.mode == _EXPERIMENT:
            if record.number >= 0:
                self._ticks.append(tuple(getattr(record, name) for name in _TICK_FIELDS))
        else:
            self._over = bool(self._ticks)

    def experiment(self) -> ExperimentRecord:
        """What was gathered.

        Raises
        ------
        IdentifyError
            If there was no such experiment, or nothing of it.
        """
        if not self._ticks or not self._injected:
            msg = (
                f"no experiment {self._name} on loop {self._loop} in these records; "
                f"run `fitctl identify {self._name}` on the rig first"
            )
            raise IdentifyError(msg)
        columns = zip(*self._ticks, strict=True)
        injected = np.array(self._injected)
        return ExperimentRecord(
            loop=self._loop,
            tick={
                name: np.array(column) for name, column in zip(_TICK_FIELDS, columns, strict=True)
            },
            injected_s=injected[:, 0],
            injected_v=injected[:, 1:],
        )


_KINDS = {kind.__name__ for kind in (Tick, ExperimentStart, InjectionRecord)}


def gather(records: Iterable[AnyRecord], loop: str, name: str) -> ExperimentRecord:
    """The last experiment of a name among records.

    Raises
    ------
    IdentifyError
        If there is none.
    """
    gatherer = Gatherer(loop, name)
    for record in records:
        gatherer.take(record)
    return gatherer.experiment()


def gather_log(path: Path, loop: str, name: str) -> ExperimentRecord:
    """The last experiment of a name in a log, finished or not.

    Raises
    ------
    IdentifyError
        If there is none.
    LogError
        If the log cannot be read.
    """
    topics = [TOPICS[kind].format(loop=loop) for kind in (Tick, ExperimentStart, InjectionRecord)]
    gatherer = Gatherer(loop, name)
    for entry in read_records(path, topics):
        gatherer.take(entry.message)
    return gatherer.experiment()
