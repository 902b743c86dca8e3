"""Reading a run: what a report needs of hours of log, small enough to hold.

A tick takes about 120 bytes: a night of eight hours at 50 Hz 170 MB, at 500 Hz ten times that. Frames are not
read. All times are seconds after the run's first record.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.logging.errors import LogError
from fitctl.logging.files import MEND
from fitctl.logging.reading import HEADER, Columns, column_blocks, own_times_s
from fitctl.logging.records import (
    MOST,
    ControllerChange,
    DeviceHealth,
    Event,
    LoopTiming,
    MetrologyTick,
    ModeChange,
    Overlap,
    RecorderStatus,
    SequenceAttempt,
    Tick,
)
from fitctl.logging.schemas import TOPICS
from fitctl.messages.modes import Mode
from fitctl.report.run import Run

_ROWS = 2_000  # of a topic, held as they come before they find their place
_KINDS: dict[Any, str] = {
    LoopTiming: "timing",
    ControllerChange: "changes",
    ModeChange: "modes",
    Event: "events",
    DeviceHealth: "health",
    SequenceAttempt: "attempts",
    RecorderStatus: "recorder",
}
_NUMBERS, _TEXT = "fib", "U"  # as numpy names kinds of values
_FIELDS: dict[str, dict[str, str]] = {
    name: {
        one.name: _NUMBERS if one.type in (int, float) else _TEXT
        for one in msgspec.structs.fields(kind)
    }
    for kind, name in _KINDS.items()
} | {
    "events": {"level": _NUMBERS, "name": _TEXT, "message": _TEXT},  # as Foxglove has them
    "recorder": {"lost": _NUMBERS},
}
_DEFAULTS: dict[str, dict[str, Any]] = {
    name: {one.name: one.default for one in msgspec.structs.fields(kind) if not one.required}
    for kind, name in _KINDS.items()
}
TICK_FIELDS: dict[str, Any] = {
    "time_s": np.float64,
    "mid_exposure_s": np.float64,
    "siderostat_az_rad": np.float64,
    "siderostat_el_rad": np.float64,
    "siderostat_setpoint_az_rad": np.float64,
    "siderostat_setpoint_el_rad": np.float64,
    "sky_az_rad": np.float64,
    "sky_el_rad": np.float64,
    "number": np.int64,
    "mode_number": np.int8,
    "late": np.bool_,
    "star_visible": np.bool_,
    "fsm_saturated": np.bool_,
    "held": np.bool_,
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

_OF_A_HELD_STAR = (
    *("error_az_px", "error_el_px", "target_az_px", "target_el_px", "fsm_az_rad", "fsm_el_rad"),
    *("siderostat_az_rad", "siderostat_el_rad", "stack1_v", "stack2_v", "stack3_v"),
)
"""What is known at every tick in VERNIER with a star; elsewhere NaN stands for what there was not."""
_LEAST_DN = 1e-6  # of a star: far less than one pixel's least digit

LATER_FIELDS: dict[str, Any] = {"sky_az_rad": np.nan, "sky_el_rad": np.nan, "held": False}
"""What logs of earlier versions lack, and what it is there."""

LINK_FIELDS: dict[str, Any] = dict.fromkeys(("link_az_rad", "link_el_rad"), np.float64)
"""Of the ticks of a loop with a link, besides."""

BEAM_FIELDS: dict[str, Any] = {
    "time_s": np.float64,
    "number": np.int64,
    "mode_number": np.int8,
    "late": np.bool_,
    "frames_lost": np.int32,
    **dict.fromkeys(
        (
            "frame_age_s",
            "compute_s",
            "beam_az_arcsec",
            "beam_el_arcsec",
            "diode_az_plus_v",
            "diode_az_minus_v",
            "diode_el_plus_v",
            "diode_el_minus_v",
            "siderostat_az_sky_arcsec",
            "siderostat_el_sky_arcsec",
        ),
        np.float32,
    ),
}
"""Of a metrology loop's ticks."""

OVERLAP_FIELDS: dict[str, Any] = {
    "time_s": np.float64,
    "tilt_az_arcsec": np.float32,
    "tilt_el_arcsec": np.float32,
    "visibility": np.float32,
}


@dataclass(frozen=True)
class Gathered:
    """A run in hand.

    Attributes
    ----------
    run : Run
    ticks, timing : dict of str to dict of str to array
        By loop; fields as in :mod:`fitctl.logging.records`. Without any, `timing` has no more than its times.
    overlap : dict of str to array, or None
        The tilt between the stars of the rig's ``fringes.loops`` on each frame; None if the rig has no fringes.
    modes, changes, events, health, attempts : list of dict
        Records with their fields; `changes` are of controllers; of `health` only what differs from before.
    lost : int or None
        Records lost on the way to the log; None if nothing says.
    misdated : int
        Records left out because their own time is far from the times of the run.
    """

    run: Run
    ticks: dict[str, Columns]
    timing: dict[str, Columns]
    overlap: Columns | None
    modes: list[dict[str, Any]]
    changes: list[dict[str, Any]]
    events: list[dict[str, Any]]
    health: list[dict[str, Any]]
    attempts: list[dict[str, Any]]
    lost: int | None
    misdated: int


def gather(run: Run) -> Gathered:
    """Read a run, each file once.

    Raises
    ------
    LogError
        If a file cannot be read, or its records lack what a report needs.
    """
    loops = list(run.rig.loops)
    places = {
        TOPICS[kind].format(loop=loop): (name, loop)
        for kind, name in _KINDS.items()
        for loop in (loops if "{loop}" in TOPICS[kind] else [""])
    }
    series = _series(run)
    rooms = {topic: _room(run, topic, wanted) for topic, (_, wanted) in series.items()}
    filled = dict.fromkeys(series, 0)
    blocks: dict[tuple[str, str], list[Columns]] = defaultdict(list)
    rows: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    fields: dict[str, Any] = {topic: wanted for topic, (_, wanted) in series.items()}
    fields[TOPICS[RecorderStatus]] = list(_FIELDS["recorder"])
    misdated = 0
    between_s = own_times_s(run.logs[-1], run.start_ns / 1e9, run.end_ns / 1e9)
    for log in run.logs:
        states: dict[str, str] = {}
        for topic, block in column_blocks(log.path, [*series, *places], _ROWS, fields):
            columns, left_out = _of_the_run(between_s, block)
            misdated += left_out
            time_s = (columns["publish_time_ns"] - run.start_ns) / 1e9
            if topic in series:
                filled[topic] += _fill(rooms[topic], filled[topic], columns, time_s, str(log.path))
                continue
            place = name, _ = places[topic]
            whole = _whole(name, columns, str(log.path)) | {"time_s": time_s}
            if name in {"timing", "recorder"}:
                blocks[place].append(whole)
            elif name == "health":  # says the same every second, all night
                rows[place] += _changes(_rows(whole), states)
            else:
                rows[place] += _rows(whole)
    for topic, room in rooms.items():
        room.update({name: column[: filled[topic]] for name, column in room.items()})
        _in_order(room)
    lost = _joined(blocks["recorder", ""]).get("lost")  # of each recorder from its own start
    of_loop = {loop: rooms[topic] for topic, (loop, _) in series.items() if loop}
    modes = [row for loop in loops for row in _once(rows["modes", loop])]
    changes = [row for loop in loops for row in _once(rows["changes", loop])]
    return Gathered(
        run=run,
        ticks={loop: of_loop[loop] for loop in loops},
        timing={loop: _joined(blocks["timing", loop]) for loop in loops},
        overlap=next((rooms[topic] for topic, (loop, _) in series.items() if not loop), None),
        modes=sorted(modes, key=itemgetter("time_s")),
        changes=sorted(changes, key=itemgetter("time_s")),
        events=_once(rows["events", ""]),
        health=_changes(_once(rows["health", ""]), {}),
        attempts=_once(rows["attempts", ""]),
        lost=counted(lost, before=0) if lost is not None else None,
        misdated=misdated,
    )


def _series(run: Run) -> dict[str, tuple[str, dict[str, Any]]]:
    """What comes with every frame: by topic, the loop (none for the overlap) and the fields."""
    rig = run.rig
    series = {
        TOPICS[Tick].format(loop=name): (name, TICK_FIELDS | (LINK_FIELDS if loop.link else {}))
        for name, loop in rig.stellar_loops.items()
    }
    for loop in rig.metrology_loops:
        series[TOPICS[MetrologyTick].format(loop=loop)] = (loop, BEAM_FIELDS)
    if rig.fringes is not None:
        series[TOPICS[Overlap].format(loop=rig.fringes.loops[0])] = ("", OVERLAP_FIELDS)
    return series


def _of_the_run(between_s: tuple[float, float], block: Columns) -> tuple[Columns, int]:
    """The records of a block whose own time can be of the run, and how many others there are."""
    first_s, last_s = between_s
    own_s = block["publish_time_ns"] / 1e9
    inside = (own_s >= first_s) & (own_s <= last_s)
    left_out = int(np.count_nonzero(~inside))
    return {name: column[inside] for name, column in block.items()} if left_out else block, left_out


def _room(run: Run, topic: str, wanted: dict[str, Any]) -> Columns:
    """For all rows of a topic at once: put together from pieces, hours would be held twice."""
    rows = 0
    for log in run.logs:
        count, size = log.counts.get(topic, 0), log.path.stat().st_size
        if log.finished and count > size:
            msg = (
                f"{log.path}: is damaged: its index counts {count} records of {topic}, and the file has "
                f"{size} bytes; {MEND}"
            )
            raise LogError(msg)
        rows += count
    return {name: np.empty(rows, dtype) for name, dtype in wanted.items()}


def _fill(room: Columns, at: int, columns: Columns, time_s: NDArray[np.float64], path: str) -> int:
    """Put a block of ticks into their room, from row `at` on; returns how many rows there was room for."""
    _require(columns, dict.fromkeys(room, _NUMBERS), LATER_FIELDS, "ticks", path)
    block = columns | {"time_s": time_s}
    if "mid_exposure_s" in room:
        exposed_s, without_frame = columns["mid_exposure_s"], columns["number"] < 0
        _insist_on_times("mid_exposure_s", exposed_s[~(without_frame & np.isnan(exposed_s))], path)
        _insist_on_times("time_s", columns["time_s"], path)
        block["mid_exposure_s"] = exposed_s + (time_s - columns["time_s"])
        held = columns["star_visible"] & (columns["mode_number"] == Mode.VERNIER)
        for name in _OF_A_HELD_STAR:
            _refuse(name, columns[name], held & np.isnan(columns[name]), "ticks", path)
        flux_dn = columns["star_flux_dn"]  # by which the noise of the star's place is divided
        _refuse("star_flux_dn", flux_dn, held & ~(flux_dn > _LEAST_DN), "ticks", path)
    _insist_on_numbers(columns, "ticks", path)
    rows = min(
        len(time_s), len(room["time_s"]) - at
    )  # a log in the making has grown since it was counted
    for name, column in room.items():
        values = block[name][:rows] if name in block else LATER_FIELDS[name]
        if column.dtype.kind == "i":  # of a foreign log, perhaps too large for its column
            values = np.clip(values, np.iinfo(column.dtype).min, np.iinfo(column.dtype).max)
        column[at : at + rows] = values
    return rows


def _insist_on_times(name: str, times_s: NDArray[np.float64], path: str) -> None:
    if not np.all(np.abs(times_s) < MOST):  # NaN is not
        msg = f"{path}: {name} of its ticks is no time; it was not recorded by fitctl"
        raise LogError(msg)


def _insist_on_numbers(columns: Columns, what: str, path: str) -> None:
    """Refuse infinite numbers and others that no instrument logs: no mean and no plot of them says anything."""
    for name, values in columns.items():
        if values.dtype.kind == "f":
            _refuse(name, values, np.abs(values) >= MOST, what, path)


def _refuse(
    name: str, values: NDArray[Any], which: NDArray[np.bool_], what: str, path: str
) -> None:
    if which.any():
        msg = (
            f"{path}: {name} of its {what} is {values[which][0]:g}; expected a number that an instrument has; "
            "name a log that fitctl recorded"
        )
        raise LogError(msg)


def _whole(name: str, columns: Columns, path: str) -> Columns:
    """A block of records with the fields that logs of earlier versions lack, each as its default."""
    _require(columns, _FIELDS[name], _DEFAULTS[name], f"records of {name}", path)
    _insist_on_numbers(columns, f"records of {name}", path)
    rows = len(columns["publish_time_ns"])
    filled = {each: np.full(rows, default) for each, default in _DEFAULTS[name].items()}
    return filled | columns


def _require(
    columns: Columns, kinds: dict[str, str], defaults: dict[str, Any], what: str, path: str
) -> None:
    """Refuse columns that are missing and have no default, and those that hold values of another kind."""
    missing = [name for name in kinds if name not in columns and name not in defaults]
    if missing:
        msg = f"{path}: its {what} lack {', '.join(missing)}; it was recorded by another version of fitctl"
        raise LogError(msg)
    for name, kind in kinds.items():
        if name in columns and columns[name].dtype.kind not in kind:
            msg = (
                f"{path}: {name} of its {what} is {columns[name].dtype.name}; expected "
                f"{'text' if kind == _TEXT else 'numbers'}; it was not recorded by fitctl"
            )
            raise LogError(msg)


def _joined(blocks: list[Columns]) -> Columns:
    """Blocks end to end, of the fields that all have."""
    if not blocks:
        return {"time_s": np.empty(0)}
    names = [name for name in blocks[0] if all(name in block for block in blocks)]
    return _in_order({name: np.concatenate([block[name] for block in blocks]) for name in names})


def _in_order(columns: Columns) -> Columns:
    """In the order of time; what two files have both, because a recorder died between them, counts once."""
    time_s = columns["time_s"]
    if np.any(np.diff(time_s) <= 0):
        _, rows = np.unique(time_s, return_index=True)  # of the same time, the first
        for name in columns:  # one by one: all at once, hours would be held twice
            columns[name] = columns[name][rows]
    return columns


def _rows(block: Columns) -> list[dict[str, Any]]:
    """Columns as records: a column of texts has room for the longest one in every row."""
    values = zip(*(column.tolist() for column in block.values()), strict=True)
    return [dict(zip(block, row, strict=True)) for row in values]


def _once(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records in order of time, each once, though two files may have it."""
    rows.sort(key=itemgetter("time_s"))
    known: set[tuple[Any, ...]] = set()
    once = []
    for row in rows:
        # What is not a number is not equal to itself.
        key = tuple(repr(value) for name, value in row.items() if name not in HEADER[::2])
        if key not in known:
            known.add(key)
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


def counted(counts: NDArray[Any], before: int) -> int:
    """By how much a count has grown in all from `before` on; it starts anew from zero now and then."""
    more = np.diff(counts.astype(int), prepend=before)
    return int(np.where(more >= 0, more, counts).sum())
