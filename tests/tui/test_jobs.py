"""Other fitctl commands as children: real processes."""

import signal
import sys
import time

import pytest

from fitctl.tui.jobs import Job

LIMIT_S = 60.0


def finished(job):
    end_s = time.monotonic() + LIMIT_S
    while job.status is None:
        assert time.monotonic() < end_s
        time.sleep(0.05)
    return job.status


@pytest.mark.long
def test_a_job_tells_how_it_ended_and_what_it_printed():
    job = Job(["check", "no-such-rig.toml"])
    try:
        assert finished(job) == 2
        assert "no-such-rig.toml" in job.text()
    finally:
        job.end()


@pytest.mark.long
def test_a_job_is_ended_with_the_console_unless_it_is_to_outlive_it(tmp_path, monkeypatch):
    other = Job(["check", "no-such.toml"], outlives=True)
    endless = tmp_path / "python"
    endless.write_text("#!/bin/sh\nexec sleep 60\n")
    endless.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(endless))
    job = Job(["mocks", "--free-ports"])
    assert job.status is None
    job.end()
    assert job.status == -signal.SIGTERM
    other.end()
    assert finished(other) == 2
