"""Processes beside the supervisor: what goes wrong with one is always reported."""

import shutil
import time
from concurrent.futures import Future

import pytest

from fitctl.daemon.children import Child
from fitctl.daemon.run import _report_failure


@pytest.fixture
def noted():
    return []


def test_one_that_cannot_be_started_again_is_reported_and_tried_again(tmp_path, noted):
    """As it was found: announced, and never started, because the error went into a forgotten future."""
    folder = tmp_path / "s"
    folder.mkdir()
    child = Child(
        "recorder", ["no-such-command"], folder / "e", "a new one", lambda *it: noted.append(it)
    )
    child._process.wait()
    first = child._process.pid
    shutil.rmtree(folder)
    child.check()

    assert "cannot be started: [Errno 2]" in noted[-1][2]
    folder.mkdir()
    end_s = time.monotonic() + 30.0
    while child._process.pid == first:
        assert time.monotonic() < end_s
        child.check()
        time.sleep(0.05)
    child.end()


def test_when_it_was_started_is_known_only_while_it_runs(tmp_path, noted):
    before_s = time.monotonic()
    child = Child("recorder", ["record"], tmp_path / "e", "a new one", lambda *it: noted.append(it))
    assert before_s <= child.started_s <= time.monotonic()
    child.end()
    assert child.started_s is None


def test_whatever_a_check_raises_becomes_an_event(noted):
    checked = Future()
    checked.set_exception(RuntimeError("boom"))

    _report_failure("recorder", lambda *it: noted.append(it), checked)

    assert noted == [("error", "recorder", "the recorder could not be checked: RuntimeError: boom")]
