"""Other fitctl commands as children: real processes."""

import json
import os
import signal
import sys
import time

import pytest

from fitctl.tui.jobs import MOST_BYTES, Job, printed_json

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


@pytest.mark.long
def test_a_long_json_document_is_read_whole():
    job = Job(["check", "no-such-rig.toml"])
    finished(job)
    document = json.dumps(["star"] * MOST_BYTES).encode()
    os.ftruncate(job._output.fileno(), 0)
    os.pwrite(job._output.fileno(), document, 0)
    try:
        assert printed_json(job) == ["star"] * MOST_BYTES
        os.pwrite(job._output.fileno(), b"a warning", len(document))
        with pytest.raises(ValueError, match=r"fitctl check no-such-rig.toml: cannot be shown: "):
            printed_json(job)
    finally:
        job.end()
