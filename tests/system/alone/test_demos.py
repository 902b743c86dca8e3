"""Demos beside each other: each has its instrument, and the first has the rig's own sockets."""

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from ..conftest import fitctl


@pytest.fixture
def sockets():
    folder = Path(f"/tmp/fitctl-test-{os.getpid()}-{time.monotonic_ns()}")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def test_two_demos_begun_at_once_are_two_instruments(tmp_path, sockets):
    demos = [
        fitctl(
            "demo",
            "--headless",
            "--duration",
            1,
            *("--set", f"logging.folder={tmp_path}"),
            *("--set", f"service.folder={sockets}"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for _ in range(2)
    ]
    try:
        ended = [demo.communicate(timeout=90) for demo in demos]
    finally:
        for demo in demos:
            demo.kill()

    for summary, errors in ended:
        assert "loop right" in summary, errors
        lines = [line for line in errors.splitlines() if line.startswith("demo:")]
        assert all(line.startswith("demo: another demo or supervisor has rig") for line in lines)
    assert len(list(tmp_path.glob("*.mcap"))) == 2
