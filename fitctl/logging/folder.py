"""A folder of logs: names of new ones, which are in use, which are kept, and which have had their time."""

from __future__ import annotations

import fcntl
import math
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import NamedTuple

from fitctl.config import Logging
from fitctl.files import open_regular
from fitctl.logging.errors import LogError

_DAY_S = 86_400.0


def new_log_path(folder: Path, rig_name: str, start: datetime) -> Path:
    """``<rig>_<UTC yyyymmddThhmmssZ>.mcap`` in `folder`, with ``_2``, ``_3``... if it exists already.

    Raises
    ------
    LogError
        If the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = (
            f"{folder}: cannot be made: {error.strerror}; name another folder for logs "
            "(key logging.folder of the rig file)"
        )
        raise LogError(msg) from error
    stem = f"{rig_name}_{start.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    names = (stem if number == 1 else f"{stem}_{number}" for number in count(1))
    return next(path for name in names if not (path := folder / f"{name}.mcap").exists())


def log_name(rig_name: str) -> re.Pattern[str]:
    """What a recorder of a rig calls its logs (:func:`new_log_path`); group 1 is the time."""
    return re.compile(re.escape(rig_name) + r"_(\d{8}T\d{6})Z(_\d+)?\.mcap")


def in_use(path: Path) -> bool:
    """Whether some recorder has this log open; false where the folder knows no locks.

    Raises
    ------
    LogError
        If there is something of that name that cannot be opened.
    """
    try:
        stream = open_regular(path)
    except FileNotFoundError:
        return False
    except OSError as error:
        msg = f"{path}: cannot be opened: {error.strerror}; a log is a file that may be read"
        raise LogError(msg) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
    return False


def keep_mark(path: Path) -> Path:
    """The file beside a log that says "keep this one"; it goes where plain copies of a folder go."""
    return path.with_name(path.name + ".keep")


def is_kept(path: Path) -> bool:
    """Whether retention must leave this log alone."""
    return keep_mark(path).exists()


def keep(path: Path, *, kept: bool) -> None:
    """Mark a log, so that retention never deletes it, or take the mark away.

    Raises
    ------
    LogError
        If there is no such log, or the mark cannot be written.
    """
    if not path.is_file():
        msg = f"{path}: no such log; name a *.mcap in the rig's logging.folder"
        raise LogError(msg)
    try:
        if kept:
            keep_mark(path).touch()
        else:
            keep_mark(path).unlink(missing_ok=True)
    except OSError as error:
        msg = f"{keep_mark(path)}: cannot be changed: {error.strerror}; the folder needs write permission"
        raise LogError(msg) from error


class Pruned(NamedTuple):
    """What became of the logs that had had their time: gone, or why one is still there."""

    deleted: list[Path]
    refused: list[str]


def prune(folder: Path, rig_name: str, settings: Logging, now: datetime) -> Pruned:
    """Delete what is too old or too much of one rig's logs, the oldest first.

    Only files that a recorder named count and go. Of these, the ones in use and the ones that are kept
    count, but stay. One that cannot be deleted keeps none of the others. Age deletes one file a pass, and
    does not count a pause longer than `retain_days`: a clock that is wrong by as much looks the same.

    Parameters
    ----------
    folder : Path
    rig_name : str
    settings : Logging
        How much may stay (``retain_bytes``) and how long (``retain_days``, since the last write).
    now : datetime
        Against which ages are computed.

    Returns
    -------
    Pruned
    """
    pruned = Pruned([], [])
    logs = sorted(_logs_of(folder, rig_name, pruned.refused))
    total_bytes = sum(log.size_bytes for log in logs)
    kept_bytes = 0
    retain_s = timedelta(days=settings.retain_days).total_seconds()
    ages_s, pause_s = _ages_s([log.written_s for log in logs], now.timestamp(), retain_s)
    if logs and ages_s[0] <= retain_s < now.timestamp() - logs[0].written_s:
        pruned.refused.append(
            f"{folder}: no log was written for {pause_s / _DAY_S:.0f} days, or the computer's clock is wrong; "
            "logs from before are not deleted because of their age: check the clock"
        )
    by_age = 1
    for log, age_s in zip(logs, ages_s, strict=True):
        too_old = by_age > 0 and age_s > retain_s
        if not too_old and total_bytes <= settings.retain_bytes:
            break
        path = log.path
        try:
            if is_kept(path):
                kept_bytes += log.size_bytes
                continue
            if in_use(path):
                continue
            path.unlink(missing_ok=True)
        except LogError as error:
            pruned.refused.append(str(error))
        except OSError as error:
            pruned.refused.append(
                f"{path}: is due for deletion, but cannot be deleted: {error.strerror}"
            )
        else:
            by_age -= too_old
            total_bytes -= log.size_bytes
            pruned.deleted.append(path)
    if kept_bytes and total_bytes > settings.retain_bytes:
        pruned.refused.append(
            f"{folder}: logs marked with `fitctl log keep` have {kept_bytes} bytes, so all logs together "
            f"exceed logging.retain_bytes = {settings.retain_bytes}; move some, or unmark them"
        )
    return pruned


class _Log(NamedTuple):
    """A recorder's file; `written_s` is the later of its name's time and its last write."""

    written_s: float
    path: Path
    size_bytes: int


def _logs_of(folder: Path, rig_name: str, refused: list[str]) -> Iterator[_Log]:
    """The logs of a rig; `refused` gets a line for each that cannot be examined."""
    name = log_name(rig_name)
    for path in folder.glob("*.mcap"):
        found = name.fullmatch(path.name)
        if not found:
            continue
        try:
            status = path.stat()
        except FileNotFoundError:
            continue  # somebody else deletes too
        except OSError as error:
            refused.append(f"{path}: cannot be examined, so it is not deleted: {error.strerror}")
            continue
        yield _Log(max(status.st_mtime, _start_s(found[1])), path, status.st_size)


def _start_s(stamp: str) -> float:
    """Seconds since 1970 of the time in a log's name; -inf for digits that are no time."""
    try:
        return datetime.strptime(stamp, "%Y%m%dT%H%M%S").replace(tzinfo=UTC).timestamp()
    except ValueError:
        return -math.inf


def _ages_s(
    written_s: Sequence[float], now_s: float, longest_pause_s: float
) -> tuple[list[float], float]:
    """Ages of logs, given the oldest first, and the longest pause that they do not count.

    A single log before a pause counts it: one log is no evidence that the clock is wrong, and its deletion
    costs no other.
    """
    ages_s = []
    age_s = longest_s = 0.0
    after_s = now_s
    for number, before_s in reversed(list(enumerate(written_s))):
        pause_s = after_s - min(before_s, after_s)
        if pause_s > longest_pause_s and number > 0:
            longest_s = max(longest_s, pause_s)
        else:
            age_s += pause_s
        ages_s.append(age_s)
        after_s = min(before_s, after_s)
    return ages_s[::-1], longest_s
