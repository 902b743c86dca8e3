"""What a step of a sequence left in the log: the ticks of one loop while its last attempt worked."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import loop_records
from fitctl.logging.reading import Columns
from fitctl.logging.records import MetrologyTick, SequenceAttempt, Tick

TickKind = type[Tick] | type[MetrologyTick]


def gather_step(records: Iterable[Any], kind: TickKind, loop: str, step: str) -> Columns:
    """Fields of a loop's ticks during the last attempt at a step that was done, each of shape (ticks,).

    Raises
    ------
    IdentifyError
        If there is no such attempt, or no tick.
    """
    ticks: list[Any] = []
    found: list[Any] = []
    for record in records:
        name = type(record).__name__
        if name == kind.__name__ and record.loop == loop:
            ticks.append(record)
        elif name == SequenceAttempt.__name__ and record.loop == loop:
            if record.step == step and record.outcome == "done":
                found = [tick for tick in ticks if record.began_s <= tick.time_s <= record.ended_s]
            ticks.clear()
    if not found:
        msg = (
            f"these records have no attempt at the step {step} on loop {loop} that was done; run a sequence "
            f"with this step, and name the log that it wrote"
        )
        raise IdentifyError(msg)
    names = [field.name for field in msgspec.structs.fields(kind)]
    rows = zip(*map(attrgetter(*names), found), strict=True)
    return {name: np.array(column) for name, column in zip(names, rows, strict=True)}


def gather_step_log(path: Path, kind: TickKind, loop: str, step: str) -> Columns:
    """The same from a log.

    Raises
    ------
    IdentifyError
        As :func:`gather_step`, or if a record is not as fitctl records it.
    LogError
        If the log cannot be read.
    """
    return gather_step(loop_records(path, loop, kind, SequenceAttempt), kind, loop, step)
