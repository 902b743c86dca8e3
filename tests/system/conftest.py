"""The real thing: every process, every wire, real time."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from instruments.served import free_port

from fitctl.config import default_rig_path
from fitctl.messages.client import Client
from fitctl.messages.commands import Acquire, Shutdown, Standby
from fitctl.processes import rig_arguments

START_S = 60.0
WITH_US = ("--parent-pid", os.getpid())  # they end when the tests are killed
# In a shell's background it is ignored, also by children.
signal.signal(signal.SIGINT, signal.default_int_handler)
NEAR = "plant.loops.right.star_offset_sky_arcsec_max=5.0"  # found at once

OWN_NAMES = """
import os
from fitctl.messages import endpoints
endpoints.supervisor_names = lambda: os.environ["TEST_SUPERVISOR_NAMES"]
"""


def fitctl(*arguments, before=(), **options):
    """Start ``fitctl ARGUMENTS``; `before` goes before it on the command line, such as ``env NAME=VALUE``."""
    return subprocess.Popen(
        [*before, sys.executable, "-m", "fitctl", *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        text=True,
        **options,
    )


def folders(logs, sockets):
    """Options by which a demo has its log and its sockets in folders of the test."""
    return ("--set", f"logging.folder={logs}", "--set", f"service.folder={sockets}")


def end(process, number=signal.SIGTERM, timeout_s=20.0):
    """Send a signal and wait; returns the exit status."""
    if process.poll() is None:
        process.send_signal(number)
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


def child(pid, command):
    """The process of ``fitctl COMMAND`` below another; one that is being started is waited for."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        for process in psutil.Process(pid).children(recursive=True):
            with suppress(psutil.Error):  # it ends at this moment
                if command in process.cmdline():
                    return process
        time.sleep(0.05)
    raise AssertionError(f"no fitctl {command} within {START_S} s")


def nothing_was_lost_without_a_stall(summary):
    """A machine that stood still excuses the frames of that time, and no more."""
    excused = summary["machine_stalls"] * (1 + summary["worst_stall_s"] * 50)
    return summary["frames_lost"] <= excused


def absent_devices():
    """Addresses of the mock rig's devices where nothing listens, and which no other test's supervisor has."""
    return {
        "loops.right.siderostat.device.channel": f"socket://127.0.0.1:{free_port()}",
        "loops.right.fsm.dac.port": free_port(),
        "loops.right.fsm.piezo.port": f"socket://127.0.0.1:{free_port()}",
    }


class Rig:
    """Mock testbed and supervisor of a test, each of which the test may kill and start again."""

    def __init__(self, folder: Path, file: Path | None = None):
        self.folder = folder
        self.sockets = Path(f"/tmp/fitctl-test-{os.getpid()}-{time.monotonic_ns()}")
        self.file = file or default_rig_path()
        # The bench has a port of its own: another test's could take the usual one while mocks are started anew.
        self.settings = [
            f"logging.folder={folder}",
            f"service.folder={self.sockets}",
            f"mocks.bench_port={free_port()}",
        ]
        self.before = ()  # what goes before the supervisor on its command line
        self.errors = None  # where the error output of mocks and supervisor goes; None is our own
        self.mocks = self.supervisor = None
        self.client = None

    @property
    def common(self):
        """Options by which another process is told this rig."""
        return rig_arguments(self.file, self.settings)

    def start_mocks(self, *arguments, settings=()):
        self.mocks = fitctl(
            "mocks",
            *rig_arguments(self.file, [*self.settings, *settings]),
            *WITH_US,
            "--json",
            *arguments,
            stdout=subprocess.PIPE,
            stderr=self.errors,
        )
        self.endpoints = json.loads(self.mocks.stdout.readline())

    def restart_mocks(self):
        """New mock devices where the old ones listened."""
        ports = {
            "mocks.gvcp_port": self.endpoints["camera.device.gvcp_port"],
            "mocks.bench_port": self.endpoints["mocks.bench_port"],
            "mocks.loops.right.slcan_port": self._port("loops.right.siderostat.device.channel"),
            "mocks.loops.right.modbus_port": self.endpoints["loops.right.fsm.dac.port"],
            "mocks.loops.right.mdt693_port": self._port("loops.right.fsm.piezo.port"),
        }
        self.start_mocks(settings=[f"{key}={port}" for key, port in ports.items()])

    def _port(self, key):
        return self.endpoints[key].rpartition(":")[2]

    def start_supervisor(self):
        devices = [
            f"{key}={value}"
            for key, value in self.endpoints.items()
            if not key.startswith("mocks.")
        ]
        self.supervisor = fitctl(
            "run",
            *rig_arguments(self.file, [*self.settings, *devices]),
            *WITH_US,
            before=self.before,
            stdout=subprocess.PIPE,
            stderr=self.errors,
        )
        assert "supervising" in self.supervisor.stdout.readline()
        self.client = Client(self.sockets)

    def follow(self, reached, limit_s=START_S):
        """Receive telemetry until `reached(telemetry)`; returns all of it."""
        seen = []
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s:
            telemetry = self.receive(0.5)
            if telemetry is not None:
                seen.append(telemetry)
                if reached(telemetry):
                    return seen
        mode = seen[-1].loops[0].mode if seen else "no telemetry"
        events = [event.message for telemetry in seen for event in telemetry.events]
        raise AssertionError(f"not reached within {limit_s} s; {mode}; {events}")

    def receive(self, timeout_s):
        """The next telemetry message, or None when none came in time."""
        return self.client.receive(timeout_s)

    def follow_to(self, mode, limit_s=START_S):
        return self.follow(lambda telemetry: telemetry.loops[0].mode == mode, limit_s)

    def to_vernier(self):
        assert self.client.send(Standby()).accepted
        self.follow_to("STANDBY")
        assert self.client.send(Acquire()).accepted
        return self.follow_to("VERNIER")

    def recorder(self):
        """The recorder process; one that is just being started is waited for."""
        return self.child("record")

    def child(self, command):
        """The process of ``fitctl COMMAND`` beside the supervisor; one that is being started is waited for."""
        return child(self.supervisor.pid, command)

    def close(self):
        if self.client is not None:
            if self.supervisor.poll() is None:
                self.client.send(Shutdown())
            self.client.close()
        for process in (self.supervisor, self.mocks):
            if process is not None:
                end(process)
                process.stdout.close()
        for path in sorted(self.sockets.glob("*")):
            path.unlink(missing_ok=True)
        if self.sockets.exists():
            self.sockets.rmdir()


@contextmanager
def running(folder, *settings, file=None, kind=Rig, before=(), mocks=()):
    """Mock testbed and supervisor of a rig, with some values replaced; `mocks` are options of the testbed."""
    rig = kind(folder, file)
    rig.before = before
    rig.settings += settings
    try:
        rig.start_mocks("--free-ports", *mocks)
        rig.start_supervisor()
        yield rig
    finally:
        rig.close()


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path) as rig:
        yield rig


@pytest.fixture
def own_names(tmp_path):
    """What goes before a command line, so that it knows this test's supervisors and no others."""
    folder = tmp_path / "own_names"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(OWN_NAMES)
    names = f"fitctl-test:{os.getpid()}:{time.monotonic_ns()}:"
    return ["env", f"PYTHONPATH={folder}", f"TEST_SUPERVISOR_NAMES={names}"]


@pytest.fixture
def said(own_names):
    """Exit status, output and error output of a command."""

    def run(*arguments):
        done = subprocess.run(
            [*own_names, sys.executable, "-m", "fitctl", *arguments],
            capture_output=True,
            text=True,
            timeout=START_S,
            check=False,
        )
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.fixture
def sockets():
    """A folder for sockets of a demo; those that the rig file names, only one demo of the machine has."""
    folder = Path(f"/tmp/fitctl-test-{os.getpid()}-{time.monotonic_ns()}")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
