"""A real run's log: replayed to the last bit, and shown to another supervisor over the wire."""

import json
import subprocess
import sys

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.reading import read_records
from fitctl.messages.commands import SetTarget, Shutdown, Stop
from tests.instruments.simulated import SOON
from tests.samples.logged_simulation import LoggedSimulation

from .conftest import NEAR, end, running

FRAMES = "/fit/camera/frame"


def replayed(log):
    """What `fitctl replay --json LOG` says, and its exit status."""
    arguments = [sys.executable, "-m", "fitctl", "replay", "--json", log]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    return json.loads(done.stdout), done.returncode


def frames(log):
    return [entry.message.data for entry in read_records(log, [FRAMES])]


def finished(rig):
    """End the supervisor, once there is a recorder to finish its log; the log."""
    rig.follow(lambda telemetry: telemetry.recorder is not None)
    assert rig.client.send(Shutdown()).accepted
    assert rig.supervisor.wait(20) == 0
    (log,) = rig.folder.glob("*.mcap")
    return log


def test_a_real_run_replayed_decides_the_same_to_the_last_bit(tmp_path):
    dark_file = tmp_path / "dark.npy"
    np.save(dark_file, np.random.default_rng(1).normal(1000.0, 30.0, (40, 40)))
    with running(tmp_path, NEAR, SOON, f"camera.dark_file={dark_file}") as rig:
        rig.to_vernier()
        assert rig.client.send(SetTarget(az_px=22.0, el_px=18.5)).accepted
        rig.follow(lambda telemetry: telemetry.ticks and telemetry.ticks[-1].number > 250)
        assert rig.client.send(Stop()).accepted
        rig.follow_to("SAFE")
        log = finished(rig)
    np.save(dark_file, np.full((40, 40), 1000.0))  # measured anew
    result, status = replayed(log)
    loop = result["loops"]["right"]

    assert (result["same"], status) == (True, 0), result
    assert loop["ticks"] > 250
    assert loop["frames_missing"] == result["records_lost"] == 0


@pytest.mark.slow
def test_a_supervisor_sees_a_logs_frames_in_place_of_the_camera(tmp_path):
    log = tmp_path / "shown.mcap"
    simulation = LoggedSimulation(load_rig(default_rig_path(), [SOON]), log)
    simulation.acquire()
    simulation.run(15.0)
    simulation.writer.close()
    with running(tmp_path / "seen", SOON, mocks=["--camera", log]) as rig:
        rig.to_vernier()  # by the light that the log has
        its_log = finished(rig)
    shown, seen = frames(log), frames(its_log)

    assert len(seen) > 20
    assert seen == shown[: len(seen)]  # over GigE Vision, bit by bit
    assert replayed(its_log)[1] == 0


def test_what_is_no_log_cannot_be_shown_and_is_told_in_one_line(tmp_path):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no log")
    arguments = [sys.executable, "-m", "fitctl", "mocks", "--free-ports", "--camera", broken]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as mocks:
        try:
            assert mocks.wait(30) == 2
            assert mocks.stderr.read().count("\n") == 1
        finally:
            end(mocks)
