"""Reading a run: what a report needs of hours of log, small enough to hold.

A tick takes about 120 bytes: a night of eight hours at 50 Hz 170 MB, at 500 Hz ten times that. Frames are not
read. All times are seconds after the run's first record.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.logging.errors import LogError
from fitctl.logging.reading import HEADER, Columns, column_blocks
from fitctl.logging.records import (
    DeviceHealth,
    Event,
    LoopTiming,
    ModeChange,
    PiezoReading,
    RecorderStatus,
    SequenceAttempt,
    Tick,
)
from fitctl.logging.schemas import TOPICS
from fitctl.report.run import Run

_ROWS = 20_000
_KINDS: dict[Any, str] = {
    Tick: "ticks",
    LoopTiming: "timing",
    PiezoReading: "piezo",
    ModeChange: "modes",
    Event: "events",
    DeviceHealth: "health",
    SequenceAttempt: "attempts",
    RecorderStatus: "recorder",
}
TICK_FIELDS: dict[str, Any] = {
    "time_s": np.float64,
    "mid_exposure_s": np.float64,
    "siderostat_az_rad": np.float64,
    "siderostat_el_rad": np.float64,
    "siderostat_setpoint_az_rad": np.float64,
    "siderostat_setpoint_el_rad": np.float64,
    "number": np.int64,
    "mode_number": np.int8,
    "late": np.bool_,
    "star_visible": np.bool_,
    "fsm_saturated": np.bool_,
    "frames_lost": np.int32,
    **dict.fromkeys(
        (
            "frame_age_s",
            "compute_s",
            "star_flux_dn",
            "target_az_px",
            "target_el_px",
            "error_az_px",
            "error_el_px",
            "fsm_az_rad",
            "fsm_el_rad",
            "fsm_range_fraction",
            "stack1_v",
            "stack2_v",
            "stack3_v",
        ),
        np.float32,
    ),
}


@dataclass(frozen=True)
class Gathered:
    """A run in hand.

    Attributes
    ----------
    run : Run
    ticks, timing, piezo : dict of str to dict of str to array
        By loop; fields as in :mod:`fitctl.logging.records`. Empty arrays where there are none.
    modes, events, health, attempts : list of dict
        Records with their fields; of `health` only what differs from before.
    lost : int or None
        Records lost on the way to the log; None if nothing says.
    """

    run: Run
    ticks: dict[str, Columns]
    timing: dict[str, Columns]
    piezo: dict[str, Columns]
    modes: list[dict[str, Any]]
    events: list[dict[str, Any]]
    health: list[dict[str, Any]]
    attempts: list[dict[str, Any]]
    lost: int | None


def gather(run: Run) -> Gathered:
    """Read a run, each file once.

    Raises
    ------
    LogError
        If a file cannot be read, or its ticks lack what a report needs.
    """
    loops = list(run.rig.loops)
    places = {
        TOPICS[kind].format(loop=loop): (name, loop)
        for kind, name in _KINDS.items()
        for loop in (loops if "{loop}" in TOPICS[kind] else [""])
    }
    blocks: dict[tuple[str, str], list[Columns]] = defaultdict(list)
    health: list[dict[str, Any]] = []
    states: dict[str, str] = {}
    fields = {TOPICS[Tick].format(loop=loop): TICK_FIELDS for loop in loops}
    for log in run.logs:
        for topic, columns in column_blocks(log.path, list(places), _ROWS, fields):
            place = places[topic]
            time_s = (columns["publish_time_ns"] - run.start_ns) / 1e9
            kept = _small(columns, time_s, str(log.path)) if place[0] == "ticks" else columns
            block = kept | {"time_s": time_s}
            if place[0] == "health":  # tells the same every second, all night
                health += _changes(_rows([block]), states)
            else:
                blocks[place].append(block)
    of_loops = {
        name: {loop: _in_order(_joined(blocks.pop((name, loop), []))) for loop in loops}
        for name in ("ticks", "timing", "piezo")
    }
    modes = [row for loop in loops for row in _rows(blocks["modes", loop])]
    return Gathered(
        run=run,
        **of_loops,
        modes=sorted(modes, key=itemgetter("time_s")),
        events=_rows(blocks["events", ""]),
        health=health,
        attempts=_rows(blocks["attempts", ""]),
        lost=_lost(_rows(blocks["recorder", ""])),
    )


def _small(columns: Columns, time_s: NDArray[np.float64], path: str) -> Columns:
    """A block of ticks, only what is needed and no longer than needed."""
    missing = [name for name in TICK_FIELDS if name not in columns]
    if missing:
        msg = f"{path}: its ticks lack {', '.join(missing)}; it was recorded by another version of fitctl"
        raise LogError(msg)
    columns["mid_exposure_s"] = columns["mid_exposure_s"] + (time_s - columns["time_s"])
    return {name: columns[name].astype(dtype) for name, dtype in TICK_FIELDS.items()}


def _joined(blocks: list[Columns]) -> Columns:
    """Blocks end to end; they are used up, so that hours are not held twice."""
    if not blocks:
        return {name: np.empty(0, dtype) for name, dtype in TICK_FIELDS.items()}
    names = [name for name in blocks[0] if all(name in block for block in blocks)]
    return {name: np.concatenate([block.pop(name) for block in blocks]) for name in names}


def _in_order(columns: Columns) -> Columns:
    """What two files have both, because a recorder died between them, counts once."""
    time_s = columns["time_s"]
    new = np.ones(len(time_s), bool)
    new[1:] = time_s[1:] > np.maximum.accumulate(time_s)[:-1]
    return columns if new.all() else {name: column[new] for name, column in columns.items()}


def _rows(blocks: list[Columns]) -> list[dict[str, Any]]:
    """Columns as records, in order of time, each once."""
    rows = [
        dict(zip(block, row, strict=True))
        for block in blocks
        for row in zip(*(column.tolist() for column in block.values()), strict=True)
    ]
    rows.sort(key=itemgetter("time_s"))
    seen: set[tuple[Any, ...]] = set()
    once = []
    for row in rows:
        key = tuple(value for name, value in row.items() if name not in HEADER[::2])
        if key not in seen:
            seen.add(key)
            once.append(row)
    return once


def _changes(health: list[dict[str, Any]], states: dict[str, str]) -> list[dict[str, Any]]:
    """Where a device is not as it was before; `states` is kept up."""
    changed = []
    for row in health:
        if states.get(row["device"]) != row["state"]:
            states[row["device"]] = row["state"]
            changed.append(row)
    return changed


def _lost(statuses: list[dict[str, Any]]) -> int | None:
    """Records lost before the log; each recorder counts from its own start."""
    total = before = 0
    for status in statuses:
        lost = int(status["lost"])
        total += lost - before if lost >= before else lost
        before = lost
    return total if statuses else None
