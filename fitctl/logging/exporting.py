"""Logs as CSV, Parquet and NumPy files, one for each topic; units stay in the names of the columns."""

from __future__ import annotations

import csv
import importlib
import re
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from fitctl.logging.errors import LogError
from fitctl.logging.reading import Columns, column_blocks
from fitctl.logging.records import Event, FrameRecord
from fitctl.logging.schemas import TOPICS

_ROWS = 5000  # of one topic in memory at a time
# Columns of Foxglove's messages, by topic, as fitctl's own records name them.
_RENAMED = {
    TOPICS[Event]: {"name": "source"},
    TOPICS[FrameRecord]: {"width": "width_px", "height": "height_px", "frame_id": "camera"},
}

Write = Callable[[Columns], None]


def export(path: Path, folder: Path, kind: str, topics: list[str]) -> dict[Path, int]:
    """Write each topic of a log into a file of its own.

    Column names are the record's fields, and before them ``log_time_ns`` and ``publish_time_ns``
    (nanoseconds since 1970) and ``sequence``. Frames are ``pixels_dn``: in NumPy shape (frames, height,
    width), in Parquet little-endian 16 bit, row by row; CSV has no frames. Other bytes, such as the snapshots',
    are Base64 in CSV, and in NumPy one array of all bytes with the lengths beside it, ``NAME_lengths``.

    Parameters
    ----------
    path : Path
        A log, finished or not.
    folder : Path
        Made with the first file if missing; no file in it is overwritten.
    kind : str
        One of :data:`KINDS`.
    topics : list of str
        Which.

    Returns
    -------
    dict of Path to int
        The files and their rows.

    Raises
    ------
    LogError
        If the log cannot be read, a file exists or cannot be written, or pyarrow is missing for Parquet.
        No file is left then, and no empty folder.
    """
    rows: dict[Path, int] = {}
    existed = folder.exists()
    try:
        _write_all(path, folder, kind, topics, rows)
    except BaseException as error:
        for file in rows:  # part of a log is not what was asked for
            file.unlink(missing_ok=True)
        if not existed:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            msg = f"{folder}: cannot be written: {error.strerror or error}; make room, or give another --out"
            raise LogError(msg) from error
        raise
    return rows


def _write_all(
    path: Path, folder: Path, kind: str, topics: list[str], rows: dict[Path, int]
) -> None:
    """Write, and keep count in `rows`, which has every file that was begun."""
    writers: dict[str, Write] = {}
    with ExitStack() as stack:
        for topic, columns in _blocks(path, topics, frames=kind != "csv"):
            file = (
                folder
                / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', topic.strip('/').replace('/', '.'))}.{kind}"
            )
            if topic not in writers:
                if file in rows:
                    msg = f"{path}: {topic} and another topic both become {file.name}; export each with --topic"
                    raise LogError(msg)
                if file.exists():
                    msg = f"{file}: exists already; give another folder with --out"
                    raise LogError(msg)
                folder.mkdir(parents=True, exist_ok=True)
                rows[file] = 0
                writers[topic] = KINDS[kind](file, stack)
            writers[topic](columns)
            rows[file] += len(columns["sequence"])


def _blocks(path: Path, topics: list[str], *, frames: bool) -> Iterator[tuple[str, Columns]]:
    wanted = [topic for topic in topics if frames or topic != TOPICS[FrameRecord]]
    for topic, columns in column_blocks(path, wanted, _ROWS):
        try:
            if topic == TOPICS[FrameRecord]:
                columns["pixels_dn"] = columns.pop("data")
                del columns["encoding"], columns["step"]  # mono16, and twice the width
            elif topic == TOPICS[Event]:
                levels = columns["level"].tolist()
                columns["level"] = np.array([Log.Level.Name(level) for level in levels])
                del columns["file"], columns["line"]
        except (KeyError, TypeError, ValueError) as error:
            raise _foreign(f"{path}: {topic}", error) from None
        renamed = _RENAMED.get(topic, {})
        yield topic, {renamed.get(name, name): column for name, column in columns.items()}


def _foreign(what: str, error: Exception) -> LogError:
    return LogError(
        f"{what} is not as fitctl records it: {error}; choose other topics with --topic, or name a log that "
        "fitctl recorded"
    )


def _csv(file: Path, stack: ExitStack) -> Write:
    stream = stack.enter_context(file.open("x", newline="", encoding="utf-8"))
    rows = csv.writer(stream)

    def write(columns: Columns) -> None:
        if not stream.tell():
            rows.writerow(columns)
        rows.writerows(zip(*map(_cells, columns.values()), strict=True))

    return write


def _cells(column: NDArray[Any]) -> list[Any]:
    values = column.tolist()
    return [b64encode(value).decode() for value in values] if column.dtype == object else values


def _parquet(file: Path, stack: ExitStack) -> Write:
    try:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        msg = "Parquet needs pyarrow: pip install 'fitctl[parquet]', or export csv or npz"
        raise LogError(msg) from None
    writers: list[Any] = []

    def write(columns: Columns) -> None:
        table = arrow.table(
            {
                name: arrow.array(column.tolist()) if column.dtype.kind in "OU" else column
                for name, column in columns.items()
            }
        )
        if not writers:
            writers.append(stack.enter_context(parquet.ParquetWriter(file, table.schema)))
        writers[0].write_table(table)

    return write


def _npz(file: Path, stack: ExitStack) -> Write:
    blocks: list[Columns] = []

    def finish() -> None:
        columns: dict[str, Any] = {
            name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]
        }
        if "pixels_dn" in columns:
            try:
                columns["pixels_dn"] = _images(file, columns)
            except (KeyError, TypeError, ValueError) as error:
                raise _foreign(f"{file}: the log's frame", error) from None
        for name in [name for name, column in columns.items() if column.dtype == object]:
            values = columns[name].tolist()  # NumPy would pickle them, and refuse to read them back
            columns[name] = np.frombuffer(b"".join(values), np.uint8)
            columns[f"{name}_lengths"] = np.array([len(value) for value in values], np.int64)
        np.savez_compressed(file, **columns)

    def write(columns: Columns) -> None:
        if not blocks:
            if taken := columns.keys() & {"file", "allow_pickle"}:  # savez's own arguments
                msg = f"{file}: npz cannot hold a column named {taken.pop()}; export csv or parquet"
                raise LogError(msg)
            stack.push(lambda error, *_: finish() if error is None else None)
        blocks.append(columns)

    return write


def _images(file: Path, columns: Columns) -> Any:
    """Frames as one array, shape (frames, height, width)."""
    sizes = set(zip(columns["height_px"].tolist(), columns["width_px"].tolist(), strict=True))
    if len(sizes) > 1:
        msg = f"{file}: frames of several sizes do not go into one array; cut the log by time, or take parquet"
        raise LogError(msg)
    return np.frombuffer(b"".join(columns["pixels_dn"]), "<u2").reshape(-1, *sizes.pop())


KINDS: dict[str, Callable[[Path, ExitStack], Write]] = {
    "csv": _csv,
    "parquet": _parquet,
    "npz": _npz,
}
"""What can be exported, by the file's ending."""
