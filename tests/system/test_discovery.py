"""Which supervisor a command reaches when none is named, over real processes: `fitctl run` and `fitctl demo`.

The names by which they find each other begin with the test's own here: a stop that is for all supervisors of
this user would otherwise stop those of other tests.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fitctl.daemon.locks import only_supervisor
from fitctl.messages.commands import Status

from .conftest import START_S, Rig, absent_devices, end, fitctl

ALONE = """
import os
from fitctl.messages import endpoints
endpoints.supervisor_names = lambda: os.environ["TEST_SUPERVISOR_NAMES"]
"""


@pytest.fixture
def alone(tmp_path):
    """What goes before a command line, so that it knows this test's supervisors and no others."""
    folder = tmp_path / "alone"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(ALONE)
    names = f"fitctl-test:{os.getpid()}:{time.monotonic_ns()}:"
    return ["env", f"PYTHONPATH={folder}", f"TEST_SUPERVISOR_NAMES={names}"]


@pytest.fixture
def said(alone):
    """Exit status, output and error output of a command."""

    def run(*arguments):
        done = subprocess.run(
            [*alone, sys.executable, "-m", "fitctl", *arguments],
            capture_output=True,
            text=True,
            timeout=START_S,
            check=False,
        )
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.fixture
def start(alone, tmp_path):
    """Starts supervisors of rigs of these names, without devices: they are OFF."""
    rigs = []

    def begin(*names):
        for name in names:
            (tmp_path / name).mkdir()
            rig = Rig(tmp_path / name)
            rig.endpoints = absent_devices()
            rig.settings.append(f"name={name}")
            rig.before = alone
            rigs.append(rig)
            rig.start_supervisor()
        return rigs[-len(names) :]

    yield begin
    for rig in rigs:
        rig.close()


def mode(rig):
    """As the supervisor answers: queued telemetry may be older."""
    return rig.client.send(Status()).text.removeprefix("right ")


def test_without_a_rig_the_one_that_runs_is_meant(start, said):
    status, _, err = said("send", "status")
    assert status == 3
    assert "you have no supervisor running" in err

    (night,) = start("night")

    assert said("send", "status") == (
        0,
        "right OFF\n",
        f"rig night: {night.file} (running)\n",
    )


def test_where_several_run_they_are_named_and_only_stop_is_for_all(start, said):
    both = start("north", "south")

    for command in (["send", "standby"], ["status"], ["watch"], ["fault", "now"]):
        status, out, err = said(*command)
        assert (status, out) == (2, "")
        assert "2 supervisors run; nothing was done" in err
        for rig in both:
            place = f"--rig {rig.file} --set service.folder={rig.sockets}"
            assert f"(process {rig.supervisor.pid}): {place}" in err
    assert [mode(rig) for rig in both] == ["OFF", "OFF"]

    status, out, err = said("send", "stop")

    assert (status, out) == (0, "right SAFE\n" * 2)
    assert "2 supervisors run; stopping all of them" in err
    assert "rig north: " in err
    assert "rig south: " in err
    for rig in both:
        rig.follow_to("SAFE")


def test_a_place_that_the_error_names_reaches_that_one(start, said):
    north, south = start("north", "south")
    err = said("status")[2]
    (line,) = (line for line in err.splitlines() if line.strip().startswith("south "))

    status, _, err = said("send", "stop", *line.split("): ")[1].split())

    assert status == 0, err
    south.follow_to("SAFE")
    assert mode(north) == "OFF"


def test_one_that_was_killed_does_not_count(start, said):
    north, south = start("north", "south")
    end(south.supervisor, signal.SIGKILL)

    assert said("send", "status")[:2] == (0, "right OFF\n")
    assert f"rig north: {north.file}" in said("status")[2]


def test_shutdown_that_waits_returns_when_another_supervisor_can_start(start, said):
    (night,) = start("night")

    status, out, _ = said("send", "shutdown", "--wait")

    assert (status, out) == (0, "shutting down\nthe supervisor has ended\n")
    with only_supervisor(night.sockets):
        assert night.supervisor.wait(START_S) == 0


# ---------------------------------------------------------------- demos


@pytest.fixture
def demos(alone, tmp_path):
    """Starts a demo; its summary and what it said, once it has ended."""
    sockets = Path(f"/tmp/fitctl-test-{os.getpid()}-{time.monotonic_ns()}")
    started = []

    def begin(duration_s):
        folders = ("--set", f"logging.folder={tmp_path}", "--set", f"service.folder={sockets}")
        demo = fitctl(
            *("demo", "--headless", "--duration", duration_s, *folders),
            before=alone,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(demo)
        return demo

    yield begin, sockets
    for demo in started:
        end(demo, signal.SIGINT, START_S)
        demo.stdout.close()
        demo.stderr.close()
    shutil.rmtree(sockets, ignore_errors=True)


def runs(said, *options):
    """The status of the demo that the options name, once it answers."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        status, out, _ = said("status", "--json", *options)
        if status in {0, 1}:
            return json.loads(out)
    raise AssertionError("no demo answers")


def test_a_second_demo_says_so_and_how_to_address_it(demos, said):
    begin, sockets = demos
    first = begin(600)
    one = runs(said)
    second = begin(600)
    beside = second.stderr.readline()

    assert f"demo: another demo or supervisor has rig fit-mock in {sockets}" in beside
    options = beside.split("add: ")[1].split()
    other = runs(said, *options)
    assert other["pid"] != one["pid"]

    status, _, err = said("send", "standby")
    assert status == 2
    assert f"process {one['pid']}" in err
    assert f"process {other['pid']}" in err

    status, out, err = said("send", "stop")
    assert (status, out) == (0, "right SAFE\n" * 2)
    assert "2 supervisors run; stopping all of them" in err
    end(second, signal.SIGINT, START_S)
    assert [loop["mode"] for loop in runs(said)["loops"]] == ["SAFE"]
    end(first, signal.SIGINT, START_S)
    assert "another demo" not in first.stderr.read()
