"""What a commissioning has found, beside its rig file: a record to go on from, and a rig file to run with."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
import tomlkit

from fitctl.commissioning.outcome import DONE, Outcome, State
from fitctl.config import ConfigError
from fitctl.config.reading import lay_over
from fitctl.files import open_regular, read_regular, replaced_whole
from fitctl.text import UNDECODABLE

_MOST_BYTES = 16 << 20
_FOUND_MARK = b"# Found by `fitctl commission`"
_RIG_MARK = b"# Written by `fitctl commission`"
_PAGE_MARK = b"<title>Commissioning of "
_MARKED = 500  # within so many bytes of its beginning, each file has its mark


class Entry(msgspec.Struct, frozen=True):
    """One task, as it was done last.

    Attributes
    ----------
    state : str
    at : str
        When it ended, ISO 8601, UTC.
    took_s : float
    lines : list of str
    figures : dict
    found : dict
        Tables of the rig file.
    trouble : str
        Why it failed, or the reason for which it was skipped.
    tries : int
        How often it was done, this time included.
    """

    state: State
    at: str
    took_s: float
    lines: list[str]
    figures: dict[str, float]
    found: dict[str, Any]
    trouble: str = ""
    tries: int = 1


class Commissioning(msgspec.Struct):
    """The record of a rig's commissioning."""

    rig: str
    tasks: dict[str, Entry] = {}

    def enter(
        self, task: str, outcome: Outcome, took_s: float, state: State | None = None
    ) -> Entry:
        """Write down what came of a task."""
        earlier = self.tasks.get(task)
        self.tasks[task] = Entry(
            state or outcome.state,
            time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            round(took_s, 3),
            outcome.lines,
            {  # JSON has no other numbers
                name: float(f"{value:.6g}")
                for name, value in outcome.figures.items()
                if math.isfinite(value)
            },
            outcome.found,
            outcome.trouble,
            1 if earlier is None else earlier.tries + 1,
        )
        return self.tasks[task]

    def done(self, task: str) -> bool:
        """Whether a task need not be done again."""
        return task in self.tasks and self.tasks[task].state in DONE

    def found(self, before: str = "", order: list[str] | None = None) -> dict[str, Any]:
        """What all tasks have found, or those before one of them in an order."""
        names = list(self.tasks) if order is None else [n for n in order if n in self.tasks]
        together: dict[str, Any] = {}
        for name in names[: names.index(before)] if before in names else names:
            lay_over(together, _copy(self.tasks[name].found))
        return together

    def figures(self) -> dict[str, float]:
        """All figures, by ``task.figure``."""
        return {
            f"{task}.{name}": value
            for task, entry in self.tasks.items()
            for name, value in entry.figures.items()
        }


def _copy(table: dict[str, Any]) -> dict[str, Any]:
    return {key: _copy(value) if isinstance(value, dict) else value for key, value in table.items()}


class Files:
    """Where a commissioning's files are.

    Parameters
    ----------
    rig_path : Path
    folder : Path
        Where they are written.

    Attributes
    ----------
    record, found, rig, page : Path
        The record; the fragment with what was found; the rig file that includes it; the page to file.
    """

    def __init__(self, rig_path: Path, folder: Path) -> None:
        stem = rig_path.name.removesuffix(".toml")
        self._source = rig_path
        self.record = folder / f"{stem}.commissioning.json"
        self.found = folder / f"{stem}.found.toml"
        self.rig = folder / f"{stem}.commissioned.toml"
        self.page = folder / f"{stem}.commissioning.html"

    def require_own(self) -> None:
        """Refuse to replace files that no commissioning wrote; with a record, all are its own.

        Raises
        ------
        ConfigError
            If there is one, or one cannot be read.
        """
        if os.path.exists(self.record):
            return
        marks = {self.found: _FOUND_MARK, self.rig: _RIG_MARK, self.page: _PAGE_MARK}
        for path, mark in marks.items():
            try:
                with open_regular(path) as file:
                    is_own = mark in file.read(_MARKED)
            except FileNotFoundError:
                continue
            except OSError as error:
                msg = (
                    f"{path}: cannot be read: {error.strerror}; choose another place with --folder"
                )
                raise ConfigError(msg) from None
            if not is_own:
                msg = (
                    f"{path}: exists, and `fitctl commission` has not written it; move it, or choose another "
                    "place with --folder"
                )
                raise ConfigError(msg)

    def write_page(self, text: str) -> None:
        """Write the page to file."""
        _write(self.page, text.encode())

    def write_rig(self, found: dict[str, Any]) -> None:
        """Write what was found, and the rig file with its comments, that includes it."""
        note = b", and laid over the rig file by its include list.\n\n"
        _write(self.found, _FOUND_MARK + note + tomli_w.dumps(found).encode())
        document = tomlkit.parse(self._source.read_text(encoding="utf-8-sig"))
        nearby = self._source.parent.resolve() == self.rig.parent.resolve()

        def placed(name: str) -> str:
            return name if nearby else str((self._source.parent / name).resolve())

        names = _include_list(self._source, document)
        if "base" in document:
            document["base"] = placed(str(document["base"]))
        camera = document.get("camera")
        if isinstance(camera, dict) and "dark_file" in camera:
            camera["dark_file"] = placed(str(camera["dark_file"]))
        include = [*map(placed, names), self.found.name]
        text = tomlkit.dumps(document)
        if "include" in document:
            document["include"] = include
            text = tomlkit.dumps(document)
        else:  # a key of the document itself stands before its first table
            text = f"include = {tomlkit.item(include).as_string()}\n{text}"
        note = (
            f" from {self._source.name}: the next step writes it again. Edit that file instead.\n\n"
        )
        _write(self.rig, _RIG_MARK + f"{note}{text}".encode())


def _include_list(path: Path, document: Mapping[str, Any]) -> list[str]:
    """The include list of a rig file, or of the nearest one under it, as names from the first one's folder."""
    folder = Path()
    while "include" not in document and "base" in document:
        base = Path(str(document["base"]))
        path, folder = path.parent / base, folder / base.parent
        document = tomlkit.parse(path.read_text(encoding="utf-8-sig"))
    return [str(folder / str(name)) for name in document.get("include", [])]


def load(path: Path, rig_name: str) -> Commissioning:
    """The record of a rig; an empty one where there is none.

    Raises
    ------
    ConfigError
        If the file cannot be read, or is another rig's.
    """
    if not os.path.exists(path):
        return Commissioning(rig_name)
    record = load_any(path)
    if record.rig != rig_name:
        msg = (
            f"{path}: is of rig {record.rig}, expected {rig_name}; move it elsewhere to start again"
        )
        raise ConfigError(msg)
    return record


def load_any(path: Path) -> Commissioning:
    """The record of some rig.

    Raises
    ------
    ConfigError
        If the file cannot be read.
    """
    try:
        return msgspec.json.decode(read_regular(path, _MOST_BYTES), type=Commissioning)
    except (OSError, *UNDECODABLE) as error:
        msg = f"{path}: cannot be read as a record of a commissioning: {error}; name or move it"
        raise ConfigError(msg) from None


def save(path: Path, record: Commissioning) -> None:
    """Write a record whole.

    Raises
    ------
    ConfigError
        If it cannot be written.
    """
    _write(path, msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n")


def _write(path: Path, content: bytes) -> None:
    try:
        with replaced_whole(path) as file:
            file.write(content)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}; choose another place with --folder"
        raise ConfigError(msg) from None


def writable(folder: Path) -> bool:
    """Whether files can be written there."""
    return os.access(folder, os.W_OK)
