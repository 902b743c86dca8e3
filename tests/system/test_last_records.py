"""A run that is over before its recorder is there: what was offered is in the log, or somebody is told."""

import subprocess
import time
from contextlib import suppress

import psutil
import pytest

from fitctl.config import default_rig_path
from fitctl.daemon.last_records import HELLO_S
from fitctl.logging.reading import log_info, read_records
from fitctl.messages.client import Client
from fitctl.messages.commands import Shutdown

from .conftest import START_S, absent_devices, end, fitctl

pytestmark = pytest.mark.timeout(180)
HELD_S = 3.0


@pytest.fixture
def run_with_held_recorder(tmp_path):
    """A supervisor that answers, and its recorder, held while it was still being started."""
    sockets = tmp_path / "s"
    supervisor = fitctl(
        "run",
        *("--rig", default_rig_path()),
        *("--set", f"logging.folder={tmp_path / 'logs'}"),
        *(part for key, value in absent_devices().items() for part in ("--set", f"{key}={value}")),
        *("--set", f"service.folder={sockets}"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    recorder = recorder_of(supervisor)
    recorder.suspend()
    assert not list(tmp_path.glob("logs/*.mcap")), "the recorder was too quick for this test"
    assert "supervising" in supervisor.stdout.readline()
    client = Client(sockets)
    assert client.send(Shutdown(), timeout_s=20.0).accepted
    client.close()
    yield supervisor, recorder
    if recorder.is_running():
        recorder.kill()
    end(supervisor)
    supervisor.stdout.close()
    supervisor.stderr.close()


def recorder_of(supervisor):
    """As soon as it is there."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        for child in psutil.Process(supervisor.pid).children():
            with suppress(psutil.NoSuchProcess):  # a design's process has ended
                if "record" in child.cmdline():
                    return child
        time.sleep(0.001)
    raise AssertionError("no recorder was started")


def test_a_run_ended_before_its_recorder_was_there_is_in_the_log(run_with_held_recorder, tmp_path):
    supervisor, recorder = run_with_held_recorder
    with pytest.raises(subprocess.TimeoutExpired):
        supervisor.wait(HELD_S)
    recorder.resume()

    assert supervisor.wait(HELLO_S + START_S) == 0
    said = supervisor.stderr.read()
    assert said.startswith("waiting for the recorder to take the records of this run")
    assert "did not confirm" not in said
    (path,) = tmp_path.glob("logs/*.mcap")
    info = log_info(path)
    assert info.finished
    assert "rig" in info.metadata
    commands = [entry.message.command for entry in read_records(path, ["/fit/commands"])]
    assert commands == ["Shutdown", "Stop"]
    last_status = list(read_records(path, ["/fit/recorder/status"]))[-1].message
    assert last_status.lost == 0


def test_a_run_whose_recorder_never_came_says_what_is_missing(run_with_held_recorder, tmp_path):
    supervisor, recorder = run_with_held_recorder
    recorder.kill()

    assert supervisor.wait(START_S) == 0
    said = supervisor.stderr.read()
    assert "the recorder did not confirm the last" in said
    assert "fitctl log recover" in said
    assert not list(tmp_path.glob("logs/*.mcap"))
