"""Replaced files are whole at every moment; of files that anybody may have made, regular ones are read."""

import os
import socket

import pytest

from fitctl.config import ConfigError
from fitctl.controllers.dark import dark_bytes
from fitctl.controllers.design.files import load_design
from fitctl.files import open_regular, read_regular, write_whole
from fitctl.logging.errors import LogError
from fitctl.logging.folder import in_use
from fitctl.logging.reading import log_info


def test_a_file_that_cannot_be_written_to_its_end_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "fit-mock-dark.toml"
    path.write_bytes(b"old")

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            write_whole(path, b"new")

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_the_content_is_on_the_disk_before_the_name_is(tmp_path, monkeypatch):
    path, calls = tmp_path / "a.toml", []
    sync = os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda descriptor: (calls.append(path.exists()), sync(descriptor))
    )

    write_whole(path, b"new")

    assert calls == [False, True]


def pipe(path):
    os.mkfifo(path)


def unix_socket(path):
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))


def endless(path):
    path.symlink_to("/dev/zero")


def folder(path):
    path.mkdir()


@pytest.mark.parametrize("make", [pipe, unix_socket, endless, folder])
def test_what_is_no_regular_file_is_refused_at_once(make, tmp_path):
    """A pipe that nobody writes to would be waited for without end."""
    path = tmp_path / "a"
    make(path)
    why = "No such device" if make is unix_socket else "not a regular file"
    with pytest.raises(OSError, match=why):
        open_regular(path)
    with pytest.raises(LogError, match=why):
        log_info(path)
    with pytest.raises(LogError, match=why):
        in_use(path)
    with pytest.raises(ConfigError, match=why):
        dark_bytes(path)
    with pytest.raises(ConfigError, match=why):
        load_design(path, None, {})


def test_a_file_that_became_a_pipe_after_it_was_examined_is_refused(tmp_path, monkeypatch):
    """Between a look at the path and its opening, anybody who may write in the folder can exchange the file."""
    path = tmp_path / "a"
    path.write_bytes(b"x")
    opened = os.open

    def exchanged(name, *arguments, **options):
        path.unlink()
        os.mkfifo(path)
        return opened(name, *arguments, **options)

    monkeypatch.setattr(os, "open", exchanged)
    with pytest.raises(OSError, match="not a regular file"):
        read_regular(path, 10)


def test_a_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(1 << 20)
    assert len(read_regular(path, 1 << 20)) == 1 << 20
    with path.open("ab") as file:
        file.write(b"x")
    with pytest.raises(OSError, match="more than 1 MiB"):
        read_regular(path, 1 << 20)
