"""Files on disk: reading files of unknown origin, and replacing a file in one step."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading.

    The file is examined once it is open, so that nothing can be exchanged between examination and use.

    Raises
    ------
    OSError
        If it cannot be opened, or is a folder, a device or a pipe: these have no end, or never begin.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer; without O_NOCTTY, a terminal would become ours.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_regular(path: Path, most_bytes: int) -> bytes:
    """All of a regular file.

    Raises
    ------
    OSError
        As :func:`open_regular`, or if it has more than `most_bytes`.
    """
    with open_regular(path) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"more than {most_bytes >> 20} MiB", str(path))
    return content


@contextmanager
def replaced_whole(path: Path) -> Iterator[IO[bytes]]:
    """Write a file that, whenever the power fails, is the old one or the new one, and never a part of it.

    Raises
    ------
    OSError
        If it cannot be written; after this or any other error inside, the old one is still there.
    """
    with tempfile.NamedTemporaryFile(
        dir=path.parent, prefix=".", suffix=".part", delete=False
    ) as file:
        temporary = Path(file.name)
        try:
            yield file
            file.flush()
            os.fsync(file.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)  # the new name too
    finally:
        os.close(folder)


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file by `content`, as :func:`replaced_whole`."""
    with replaced_whole(path) as file:
        file.write(content)
