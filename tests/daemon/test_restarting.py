"""Processes beside the supervisor that die again and again."""

import subprocess
import sys
from itertools import pairwise

import pytest

from fitctl.daemon import children
from fitctl.daemon.children import Child


@pytest.mark.parametrize(("longest_s", "starts"), [(2.0, 20), (60.0, 7)])
def test_one_that_always_dies_is_started_again_within_its_longest_wait(
    tmp_path, monkeypatch, longest_s, starts
):
    now_s, started = [0.0], []

    def start(_arguments, **_options):
        process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(1)"])
        process.wait(20)
        started.append(now_s[0])
        return process

    monkeypatch.setattr(children, "start_process", start)
    monkeypatch.setattr(children.time, "monotonic", lambda: now_s[0])
    child = Child("gateway", [], tmp_path / "errors", "again", lambda *_: None, longest_s)
    for second in range(62):
        now_s[0] = float(second)
        child.check()
    monkeypatch.undo()

    waits_s = [after - before for before, after in pairwise(started)]
    assert max(waits_s) <= longest_s + 1.0  # it is looked at once a second
    assert len(started) >= starts
