"""Where stars and beams are, in a file for the supervisor that follows one that was killed."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import msgspec

from fitctl.files import read_regular
from fitctl.logging.records import MOST, Place
from fitctl.text import UNDECODABLE

FILE = "places.json"  # in the socket folder
_MOST_BYTES = 65536
_PATIENCE_S = 1.0


class Places:
    """The file of one rig; written on a thread of its own, because a disk may let everyone wait who writes.

    Parameters
    ----------
    folder : Path
        Of the rig's sockets, which only their owner may enter.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._wanted: Sequence[Place] | None = None
        self._some = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._write, name="places", daemon=True)
        self._thread.start()

    def read(self) -> list[Place]:
        """What a supervisor that was killed left; nothing where there is none, or nothing that can be read."""
        try:
            places = msgspec.json.decode(
                read_regular(self._path, _MOST_BYTES), type=list[Place], strict=True
            )
        except (OSError, *UNDECODABLE):
            return []
        return [place for place in places if _is_somewhere(place)]

    def write(self, places: Sequence[Place]) -> None:
        """Leave this; waits for nothing."""
        self._wanted = places
        self._some.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Remove the file, if the supervisor ends in order."""
        self._over.set()
        self._some.set()
        self._thread.join(_PATIENCE_S)
        if kind is None:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _write(self) -> None:
        new = self._path.with_suffix(".new")
        while self._some.wait() and not self._over.is_set():
            self._some.clear()
            with suppress(
                OSError
            ):  # the folder has vanished, or its disk is full: the place is a help, no need
                new.write_bytes(msgspec.json.encode(self._wanted))
                new.replace(self._path)


def _is_somewhere(place: Place) -> bool:
    numbers = [value for value in msgspec.structs.astuple(place) if isinstance(value, float)]
    return all(abs(number) < MOST for number in numbers)
