"""A quick look at fields of a log: in the terminal, in a window or as a picture."""

from __future__ import annotations

import contextlib
import difflib
import itertools
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.logging.errors import ForeignTopicError, LogError
from fitctl.logging.reading import HEADER, LogInfo, column_blocks, log_info
from fitctl.logging.records import MetrologyTick, Tick
from fitctl.logging.schemas import TOPICS
from fitctl.messages.modes import Mode
from fitctl.report.drawing import SERIES, TimeAxis, envelope, panels, styled, time_axis, trace
from fitctl.text import plain

Floats = NDArray[np.floating]
Limits = tuple[float, float]
MOST_FIELDS = 12
_ROWS = 20_000
_LARGEST = 1e30  # the margins about a curve must be numbers, too, in 32 bits
_TERMINAL_BINS = 400
_COLOURS = ("blue", "orange", "green", "magenta", "cyan", "red")
_MOST_PIECES = 40
_LEAST_LINES = 12  # of a panel
_TICKS = [TOPICS[kind].format(loop="*") for kind in (Tick, MetrologyTick)]
UNITS = ("px", "v", "s", "rad", "arcsec", "dn", "fraction", "progress", "ns")


class Series(NamedTuple):
    """One field of one topic; times are seconds after the log's first record.

    Of its values, `beyond` are infinite or too large for a plot, and NaN here.
    """

    topic: str
    field: str
    time_s: Floats
    values: Floats
    beyond: int = 0

    @property
    def unit(self) -> str:
        """As its name ends."""
        end = self.field.rpartition("_")[2]
        return end if end in UNITS else self.field

    @property
    def label(self) -> str:
        """Topic and field."""
        return f"{self.topic}.{self.field}"


def read_series(
    path: Path,
    wanted: Sequence[str],
    from_ns: int = 0,
    to_ns: int = 2**63 - 1,
    mode: Mode | None = None,
) -> list[Series]:
    """Fields of a log.

    Parameters
    ----------
    wanted : sequence of str
        ``TOPIC.FIELD``, ``TOPIC`` for all its fields, or ``FIELD`` of any topic; ``*`` stands for anything.
    from_ns, to_ns : int
        UTC, nanoseconds since 1970; the second is not included.
    mode : Mode, optional
        Only while the topic's loop is in this mode; for a topic of no loop, while any loop is.

    Raises
    ------
    LogError
        If the log cannot be read, one of `wanted` is nothing in it, or it is too much to look at.
    """
    info = log_info(path)
    fields = {
        topic: [] if _is_pictures(topic) else _fields(path, topic) for topic in sorted(info.counts)
    }
    chosen: dict[str, list[str]] = defaultdict(list)
    for text in wanted:
        for topic, field in _matching(path, text, fields):
            if field not in chosen[topic]:
                chosen[topic].append(field)
    number = sum(map(len, chosen.values()))
    if number > MOST_FIELDS:
        names = ", ".join(f"{topic}.{field}" for topic, its in chosen.items() for field in its)
        msg = f"{path}: {number} fields are too many to look at, at most {MOST_FIELDS}; choose of {names}"
        raise LogError(msg)
    parts: dict[tuple[str, str], list[Floats]] = defaultdict(list)
    beyond: Counter[tuple[str, str]] = Counter()
    start_ns = round(info.start_s * 1e9)
    modes = None if mode is None else _modes(path, info)
    for topic, columns in column_blocks(path, list(chosen), _ROWS, chosen):
        utc_ns = columns["publish_time_ns"]
        inside = (utc_ns >= from_ns) & (utc_ns < to_ns)
        parts[topic, ""].append((utc_ns[inside] - start_ns) / 1e9)
        in_mode = np.array(True)
        if modes is not None and mode is not None:
            in_mode = _in_mode(modes, topic, utc_ns[inside], mode)
        for field in chosen[topic]:
            values = np.where(in_mode, columns[field][inside], np.nan)
            is_beyond = np.abs(values) > _LARGEST
            beyond[topic, field] += int(np.count_nonzero(is_beyond))
            values[is_beyond] = np.nan
            parts[topic, field].append(values.astype(np.float32))
    found = [
        Series(
            topic,
            field,
            np.concatenate(parts[topic, ""]),
            np.concatenate(parts[topic, field]),
            beyond[topic, field],
        )
        for topic, its in chosen.items()
        for field in its
    ]
    return found if mode is None else list(map(_without_ends, found))


def _without_ends(series: Series) -> Series:
    """A series from its first number to its last."""
    there = np.flatnonzero(~np.isnan(series.values))
    inside = slice(there[0], there[-1] + 1) if len(there) else slice(0)
    return series._replace(time_s=series.time_s[inside], values=series.values[inside])


_Modes = dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]


def _modes(path: Path, info: LogInfo) -> _Modes:
    """Of each loop, as its ticks say: times in UTC, nanoseconds since 1970, and modes by number."""
    topics = [topic for topic in info.counts if any(fnmatchcase(topic, each) for each in _TICKS)]
    parts: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
    for topic, columns in column_blocks(
        path, topics, _ROWS, {topic: ["mode_number"] for topic in topics}
    ):
        if "mode_number" not in columns:  # another program's
            continue
        loop = topic.rpartition("/")[0]
        parts[loop].append((columns["publish_time_ns"], columns["mode_number"]))
    return {
        loop: (np.concatenate([each[0] for each in its]), np.concatenate([each[1] for each in its]))
        for loop, its in parts.items()
    }


def _in_mode(modes: _Modes, topic: str, utc_ns: Any, mode: Mode) -> NDArray[np.bool_]:
    """Which times of a topic lie in a mode: that of its loop, or of any loop."""
    of_loop = [loop for loop in modes if topic.startswith(f"{loop}/")]
    found = np.zeros(len(utc_ns), dtype=bool)
    for loop in of_loop or modes:
        at_ns, numbers = modes[loop]
        index = np.searchsorted(at_ns, utc_ns, side="right") - 1
        found |= (index >= 0) & (numbers[index] == mode)
    return found


def _fields(path: Path, topic: str) -> list[str]:
    """The numbers that a topic has."""
    # A topic of another program hinders no plot of fitctl's.
    with contextlib.suppress(ForeignTopicError):
        for _, columns in column_blocks(path, [topic], 1):
            return [
                name
                for name, column in columns.items()
                if column.dtype.kind in "fib" and name not in {*HEADER, "time_s"}
            ]
    return []


def _is_pictures(topic: str) -> bool:
    return topic.endswith("/frame")


def _matching(path: Path, text: str, fields: dict[str, list[str]]) -> list[tuple[str, str]]:
    topic_part, dot, field_part = text.rpartition(".")
    if not dot:
        topic_part, field_part = (text, "*") if text.startswith("/") else ("*", text)
    topics = [topic for topic in fields if fnmatchcase(topic, topic_part)]
    found = [
        (topic, field)
        for topic in topics
        for field in fields[topic]
        if fnmatchcase(field, field_part)
    ]
    if not found and topics and not any(fields[topic] for topic in topics):
        why = "without numbers to plot"
        if any(map(_is_pictures, topics)):
            why = (
                "of pictures, which cannot be plotted; `fitctl log export --format npz` writes them"
            )
        msg = f"{path}: {', '.join(topics)} is {why}"
        raise LogError(msg)
    if not found:
        msg = f"{path}: has no {text}; {_suggestion(topic_part, field_part, topics, fields)}"
        raise LogError(msg)
    return found


def _suggestion(topic: str, field: str, topics: Sequence[str], fields: dict[str, list[str]]) -> str:
    """What may have been meant by a topic and a field that match nothing, or else what there is."""
    if not topics:
        near = difflib.get_close_matches(topic, fields, 3, 0.8)
        return f"did you mean {' or '.join(near)}?" if near else f"topics: {', '.join(fields)}"
    known = list(dict.fromkeys(name for each in topics for name in fields[each]))
    near = difflib.get_close_matches(field, known, 3, 0.7) or [
        name for name in known if field in name
    ]
    if near:
        return f"did you mean {' or '.join(near[:3])}?"
    if topic == "*":
        return f"fields have names such as error_az_px; topics: {', '.join(fields)}"
    return f"{', '.join(topics)} has {', '.join(known)}"


def _layout(
    path: Path, series: Sequence[Series]
) -> tuple[dict[str, list[Series]], dict[str, str], TimeAxis]:
    """Series by unit, their labels as short as they differ, and the time axis of all."""
    by_unit: dict[str, list[Series]] = defaultdict(list)
    for one in series:
        by_unit[plain(one.unit)].append(one)
    topics = {one.topic for one in series}
    labels = {one.label: plain(one.field if len(topics) == 1 else one.label) for one in series}
    last_s = max((float(one.time_s[-1]) for one in series if len(one.time_s)), default=0.0)
    return by_unit, labels, time_axis(last_s, plain(path.name))


def as_text(
    path: Path, series: Sequence[Series], ylim: Limits | None = None, *, colours: bool
) -> str:
    """One panel for each unit, as wide and high as the terminal; its fields stand above it."""
    import plotext

    columns, lines = shutil.get_terminal_size()
    grouped, labels, time = _layout(path, series)
    figure: Any = plotext.figure
    figure.clear()
    figure.plot_size(columns, max(lines - 2, _LEAST_LINES * len(grouped)))
    if len(grouped) > 1:
        figure.subplots(len(grouped), 1)
    for row, (unit, its) in enumerate(grouped.items(), start=1):
        panel = figure.subplot(row, 1) if len(grouped) > 1 else figure
        panel.theme("simple" if colours else "colorless")
        _label_above(panel, [labels[one.label] for one in its], colours=colours)
        for one, colour in zip(its, itertools.cycle(_COLOURS), strict=False):
            for at_s, values in _pieces(one):
                marker = plotext.marker("hd", colour) if colours else "hd"
                points = panel.signal(
                    (at_s / time.s_per_unit).tolist(), values.tolist(), marker=marker
                )
                panel.draw(points.lines())
        if ylim is not None:
            panel.ruler("y").lim(*ylim)
        panel.label(unit, "y")
    panel.label(time.label, "x")
    return str(figure.build().string(colorless=not colours))


def _pieces(series: Series) -> Iterator[tuple[Floats, Floats]]:
    """What a terminal draws as lines: none crosses a time without values, unless there are many of them."""
    there = np.flatnonzero(np.isfinite(series.values))
    parts = np.split(there, np.flatnonzero(np.diff(there) > 1) + 1)
    for rows in [there] if len(parts) > _MOST_PIECES else parts:
        bins = max(2, round(_TERMINAL_BINS * len(rows) / max(1, len(there))))
        at_s, low, high = envelope(series.time_s[rows], series.values[rows], bins)
        both_s, both = np.repeat(at_s, 2), np.column_stack([low, high]).ravel()
        drawn = np.isfinite(both)
        if drawn.any():
            yield both_s[drawn], both[drawn]


def _label_above(panel: Any, labels: Sequence[str], *, colours: bool) -> None:
    """Put the names of the fields above a panel, in their colours: a legend would cover data."""
    import plotext

    if not colours:
        panel.title(", ".join(labels))
        return
    parts = [
        plotext.colorize(f"  {label}  ", colour)
        for label, colour in zip(labels, itertools.cycle(_COLOURS), strict=False)
    ]
    panel.title(sum(parts[1:], start=parts[0]))


def as_figure(path: Path, series: Sequence[Series], ylim: Limits | None = None) -> Any:
    """One panel for each unit, as a matplotlib figure."""
    grouped, labels, time = _layout(path, series)
    with styled():
        figure, axes = panels(len(grouped), 1.2 + 2.0 * len(grouped))
        for panel, (unit, its) in zip(axes, grouped.items(), strict=True):
            for one, color in zip(its, itertools.cycle(SERIES), strict=False):
                trace(panel, time, one.time_s, one.values, color, labels[one.label])
            panel.set_ylabel(unit)
            if panel.lines or panel.collections:
                panel.legend(
                    ncols=3, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2
                )  # above the data, not on them
            if ylim is not None:
                panel.set_ylim(*ylim)
        axes[-1].set_xlabel(time.label)
    return figure
