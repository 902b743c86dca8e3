"""Demos beside each other: each has its instrument, and the first has the rig's own sockets."""

import json
import signal
import subprocess
import time

import pytest

from ..conftest import START_S, end, fitctl, folders


def test_two_demos_begun_at_once_are_two_instruments(tmp_path, sockets):
    demos = [
        fitctl(
            "demo",
            "--headless",
            "--duration",
            1,
            *folders(tmp_path, sockets),
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


@pytest.fixture
def start_demo(tmp_path, sockets, own_names):
    """Starts a demo of ten minutes, unless the test ends it before."""
    started = []

    def start():
        demo = fitctl(
            *("demo", "--headless", "--duration", 600, *folders(tmp_path, sockets)),
            before=own_names,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(demo)
        return demo

    yield start
    for demo in started:
        end(demo, signal.SIGINT, START_S)
        demo.stdout.close()
        demo.stderr.close()


def runs(said, *options):
    """The status of the demo that the options name, once it answers."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        status, out, _ = said("status", "--json", *options)
        if status in {0, 1}:
            return json.loads(out)
    raise AssertionError("no demo answers")


def test_a_second_demo_says_so_and_how_to_address_it(sockets, start_demo, said):
    first = start_demo()
    one = runs(said)
    second = start_demo()
    beside = second.stderr.readline()

    assert f"demo: another demo or supervisor has rig fit-mock in {sockets}" in beside
    options = beside.split("add: ")[1].split()
    other = runs(said, *options)
    assert other["pid"] != one["pid"]
    assert runs(said, "--set", f"service.folder={sockets}")["pid"] == one["pid"]

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
