"""What an experiment left behind: the frames' findings, and every voltage that was injected."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.identify.errors import IdentifyError
from fitctl.logging.reading import Columns, read_records
from fitctl.logging.records import AnyRecord, ExperimentStart, InjectionRecord, Tick
from fitctl.logging.schemas import TOPICS, fields_of

Floats = NDArray[np.float64]
_TICK_FIELDS = tuple(field.name for field in msgspec.structs.fields(Tick))
_EXPERIMENT = "EXPERIMENT"
_KINDS = {kind.__name__ for kind in (Tick, ExperimentStart, InjectionRecord)}


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
    tick: Columns
    injected_s: Floats
    injected_v: Floats

    def row_at(self, time_s: Floats) -> NDArray[np.intp]:
        """The row of the injected voltages that was in force at each time, shape as `time_s`."""
        return np.maximum(np.searchsorted(self.injected_s, time_s, side="right") - 1, 0)

    @property
    def star_px(self) -> Floats:
        """Centroids (az, el), shape (ticks, 2); NaN without a star."""
        return axis_pair(self.tick, "star_{}_px")

    @property
    def motor_rad(self) -> Floats:
        """Encoders at mid-exposure (az, el), shape (ticks, 2)."""
        return axis_pair(self.tick, "siderostat_{}_rad")


def tick_columns(ticks: Iterable[Any]) -> Columns:
    """Ticks in the form of :func:`fitctl.logging.reading.tick_arrays`."""
    rows = zip(*map(attrgetter(*_TICK_FIELDS), ticks), strict=True)
    return {name: np.array(column) for name, column in zip(_TICK_FIELDS, rows, strict=True)}


def axis_pair(columns: Mapping[str, NDArray[Any]], name: str) -> Floats:
    """The columns of azimuth and elevation, shape (rows, 2); ``{}`` stands for the axis in their `name`."""
    return np.stack([columns[name.format(axis)] for axis in ("az", "el")], axis=-1, dtype=float)


def gather(records: Iterable[Any], loop: str, name: str) -> ExperimentRecord:
    """The last experiment of a name, finished or not, among records.

    Raises
    ------
    IdentifyError
        If there is none, nothing of it, or times or voltages that cannot be.
    """
    begun = over = False
    ticks: list[Any] = []
    injected: list[tuple[float, float, float, float]] = []
    for record in records:
        kind = type(record).__name__
        if kind not in _KINDS or record.loop != loop:
            continue
        if kind == ExperimentStart.__name__:
            begun, over = record.name == name, False
            if begun:
                ticks.clear()
                injected.clear()
        elif not begun or over:
            continue
        elif kind == InjectionRecord.__name__:
            injected.append((record.time_s, record.stack1_v, record.stack2_v, record.stack3_v))
        elif record.mode == _EXPERIMENT:
            if record.number >= 0:
                ticks.append(record)
        else:
            over = bool(ticks)
    if not ticks or not injected:
        msg = (
            f"no experiment {name} on loop {loop} in these records; "
            f"run `fitctl identify {name}` on the rig first"
        )
        raise IdentifyError(msg)
    table, tick = np.array(injected), tick_columns(ticks)
    times_s = (tick["time_s"], tick["mid_exposure_s"])
    finite = all(np.isfinite(values).all() for values in (table, *times_s))
    if not finite or any((np.diff(time_s) < 0).any() for time_s in (table[:, 0], tick["time_s"])):
        msg = (
            f"the experiment {name} on loop {loop} has times or voltages that are not finite, or times that "
            f"go back; expected those of one run; use its whole log, or run `fitctl identify {name}` again"
        )
        raise IdentifyError(msg)
    return ExperimentRecord(loop, tick, table[:, 0], table[:, 1:])


def gather_log(path: Path, loop: str, name: str) -> ExperimentRecord:
    """The last experiment of a name in a log, finished or not.

    Raises
    ------
    IdentifyError
        If there is none, it cannot be, or a record is not as fitctl records it.
    LogError
        If the log cannot be read.
    """
    return gather(loop_records(path, loop, Tick, ExperimentStart, InjectionRecord), loop, name)


def loop_records(path: Path, loop: str, *kinds: type[AnyRecord]) -> Iterator[AnyRecord]:
    """Records of some kinds in a log, as structs; a field that logs of earlier versions lack has its default.

    Raises
    ------
    IdentifyError
        If a record lacks a field without a default, or has a value of another kind.
    LogError
        If the log cannot be read.
    """
    by_topic = {TOPICS[kind].format(loop=loop): kind for kind in kinds}
    for entry in read_records(path, list(by_topic)):
        kind = by_topic[entry.topic]
        values = fields_of(kind, entry.message) | {"type": kind.__name__}
        try:
            record = msgspec.convert(values, kind)
        except msgspec.ValidationError as error:
            msg = (
                f"a record of {entry.topic} is not as fitctl records it: {error}; name a log that fitctl "
                "recorded"
            )
            raise IdentifyError(msg) from None
        yield record
