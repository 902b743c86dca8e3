"""A folder of logs: names of new ones, which are in use, which are kept, and which have had their time."""

from __future__ import annotations

import contextlib
import fcntl
import re
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import NamedTuple

from fitctl.config import Logging
from fitctl.logging.errors import LogError


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


def in_use(path: Path) -> bool:
    """Whether some recorder has this log open; false where the folder knows no locks.

    Raises
    ------
    LogError
        If there is something of that name that cannot be opened.
    """
    try:
        stream = path.open("rb")
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
    count, but stay. One that cannot be deleted keeps none of the others.

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
    name = re.compile(re.escape(rig_name) + r"_\d{8}T\d{6}Z(_\d+)?\.mcap")
    logs = []
    for path in folder.glob("*.mcap"):
        with contextlib.suppress(FileNotFoundError):  # somebody else deletes too
            if name.fullmatch(path.name):
                status = path.stat()
                logs.append((status.st_mtime, path, status.st_size))
    total_bytes = sum(size for *_, size in logs)
    oldest_s = (now - timedelta(days=settings.retain_days)).timestamp()
    pruned = Pruned([], [])
    for written_s, path, size in sorted(logs):
        if written_s >= oldest_s and total_bytes <= settings.retain_bytes:
            break
        try:
            if is_kept(path) or in_use(path):
                continue
            path.unlink(missing_ok=True)
        except LogError as error:
            pruned.refused.append(str(error))
        except OSError as error:
            pruned.refused.append(
                f"{path}: is due for deletion, but cannot be deleted: {error.strerror}"
            )
        else:
            total_bytes -= size
            pruned.deleted.append(path)
    return pruned
