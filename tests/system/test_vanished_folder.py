"""The socket folder is removed under a running supervisor, as systemd does at the last logout."""

import shutil
import subprocess
import time
from pathlib import Path

import pytest

from fitctl.messages.commands import RecentEvents, Status
from fitctl.processes import rig_arguments

from .conftest import START_S, Rig, fitctl


@pytest.fixture
def rig(tmp_path):
    rig = Rig(tmp_path)
    rig.start_mocks("--free-ports")
    rig.start_supervisor()
    yield rig
    rig.close()


def log_grows(rig, after_s=0.0):
    """The recorder's status comes by a command, and says that it writes; after a time of the supervisor's."""
    reports = []
    rig.follow(
        lambda t: (
            t.recorder is not None
            and t.recorder.time_s > after_s
            and (reports.append((t.recorder.path, t.recorder.records)) or True)
            and any(path == reports[-1][0] and n < reports[-1][1] for path, n in reports)
        )
    )


def test_a_vanished_folder_is_made_anew_and_everything_works_again(rig, tmp_path):
    log_grows(rig)
    recorder = rig.recorder()
    removed_s = time.monotonic()
    shutil.rmtree(rig.sockets)

    # The same client, without being asked to.
    reply = rig.client.send(Status(), timeout_s=START_S)
    back_s = time.monotonic() - removed_s

    assert reply.text == "right OFF"
    assert back_s < 5.0
    while not any(
        "have been restored" in e.message for e in rig.client.send(RecentEvents()).events
    ):
        assert time.monotonic() < removed_s + START_S
    log_grows(rig)
    # A second supervisor is kept out all the same, and so it is by another folder: by the devices.
    devices = [f"{k}={v}" for k, v in rig.endpoints.items() if not k.startswith("mocks.")]
    for folder in (rig.sockets, Path(f"{rig.sockets}-2")):
        settings = [*rig.settings, *devices, f"service.folder={folder}"]
        second = fitctl("run", *rig_arguments(rig.file, settings), stderr=subprocess.PIPE)
        _, said = second.communicate(timeout=START_S)
        assert second.returncode == 2
        assert f"process {rig.supervisor.pid} of user" in said
        if folder.exists() and folder != rig.sockets:
            shutil.rmtree(folder)
    # The recorder can be started again, although the folder of its error output was gone.
    shutil.rmtree(rig.sockets)
    recorder.kill()
    recorder.wait()
    killed_s = rig.client.send(Status(), timeout_s=START_S).time_s
    log_grows(rig, after_s=killed_s)
    assert rig.recorder().pid != recorder.pid
