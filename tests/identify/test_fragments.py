"""Calibration files are whole at every moment."""

import os

import pytest

from fitctl.identify.fragments import write_whole


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
