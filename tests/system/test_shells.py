"""A real supervisor as shells, Prometheus and systemd meet it."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress

import psutil
import pytest
from instruments.served import free_port
from prometheus_client.parser import text_string_to_metric_families

from fitctl.messages.commands import Stop

from .conftest import START_S, Rig, absent_devices, end, fitctl


@pytest.fixture
def supervisor(tmp_path):
    """One without devices: OFF, recording, and well."""
    rig = Rig(tmp_path)
    rig.endpoints = absent_devices()
    rig.metrics_port = free_port()
    rig.settings += [f"service.metrics_port={rig.metrics_port}", "interlocks.disk_space.low=0.0"]
    try:
        yield rig
    finally:
        if rig.client is not None:
            rig.close()


def said(rig, *arguments):
    """Exit status and output of a command about the rig."""
    done = subprocess.run(
        [sys.executable, "-m", "fitctl", arguments[0], *rig.common, *arguments[1:]],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def scraped(rig):
    with urllib.request.urlopen(f"http://127.0.0.1:{rig.metrics_port}/metrics", timeout=10) as page:
        return {
            sample.name: sample.value
            for family in text_string_to_metric_families(page.read().decode())
            for sample in family.samples
        }


def metrics_process(rig):
    children = psutil.Process(rig.supervisor.pid).children(recursive=True)
    return next((child for child in children if "metrics" in child.cmdline()), None)


def eventually(condition, limit_s=START_S):
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        try:
            found = condition()
        except OSError:  # not listening yet, or not any more
            found = None
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"not within {limit_s} s")


def test_the_status_tells_well_from_not_well_from_not_there(supervisor):
    status, out, err = said(supervisor, "status")
    assert (status, out) == (3, "")
    assert "fitctl run" in err

    supervisor.start_supervisor()
    supervisor.follow(lambda telemetry: telemetry.recorder is not None)
    status, out, _ = said(supervisor, "status")
    assert status == 0, out
    assert out.startswith("fit-mock: well\n")

    supervisor.client.send(Stop())
    supervisor.follow_to("SAFE")
    status, out, _ = said(supervisor, "status", "--json")
    assert status == 1
    document = json.loads(out)
    assert not document["well"]
    assert document["loops"][0]["mode"] == "SAFE"
    assert document["troubles"][0].startswith("right is SAFE")


def test_watching_goes_on_without_a_supervisor_ends_with_ctrl_c_and_with_its_pipe(supervisor):
    watching = fitctl("watch", *supervisor.common, "--json", stdout=subprocess.PIPE)
    assert json.loads(watching.stdout.readline())["kind"] == "silence"

    supervisor.start_supervisor()
    kinds = (json.loads(line) for line in watching.stdout)
    second = next(entry for entry in kinds if entry["kind"] == "second")
    assert second["loops"][0]["mode"] == "OFF"
    supervisor.client.send(Stop())
    event = next(entry for entry in kinds if entry["kind"] == "event")
    assert "SAFE" in event["message"]
    assert end(watching, signal.SIGINT) == 0
    watching.stdout.close()

    unread = fitctl("watch", *supervisor.common, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert "SAFE" in unread.stdout.readline()
    unread.stdout.close()
    assert unread.wait(START_S) == 0
    assert unread.stderr.read() == f"rig fit-mock: {supervisor.file}\n"
    unread.stderr.close()


def test_metrics_are_served_by_a_process_of_their_own_and_come_back(supervisor):
    supervisor.start_supervisor()
    seen = eventually(lambda: scraped(supervisor) if metrics_process(supervisor) else None)
    assert seen["fitctl_up"] in {0.0, 1.0}
    eventually(lambda: scraped(supervisor)["fitctl_up"] == 1)
    metrics = metrics_process(supervisor)
    listening = {c.laddr for c in metrics.net_connections("tcp") if c.status == "LISTEN"}
    assert listening == {("127.0.0.1", supervisor.metrics_port)}

    metrics.kill()
    told = supervisor.follow(
        lambda telemetry: any(
            "the metrics server was killed" in e.message for e in telemetry.events
        )
    )
    assert told
    eventually(lambda: scraped(supervisor)["fitctl_up"] == 1)

    again = metrics_process(supervisor)
    supervisor.supervisor.kill()
    supervisor.supervisor.wait()
    assert psutil.wait_procs([again], timeout=START_S)[1] == []


def test_systemd_is_told_of_start_life_and_end_and_a_deaf_one_costs_nothing(supervisor):
    address = supervisor.folder / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(START_S)
        os.environ["NOTIFY_SOCKET"] = str(address)
        try:
            supervisor.start_supervisor()
        finally:
            del os.environ["NOTIFY_SOCKET"]
        assert manager.recv(256) == b"READY=1"
        assert manager.recv(256) == b"WATCHDOG=1\nSTATUS=right OFF"
        fill(address)
        goes_on(supervisor)
        address.rename(address.with_suffix(".gone"))
        goes_on(supervisor)
        address.with_suffix(".gone").rename(address)
        manager.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                manager.recv(256)
        manager.settimeout(START_S)
        supervisor.supervisor.terminate()
        while (line := manager.recv(256)) != b"STOPPING=1":
            assert line.startswith(b"WATCHDOG=1")
        assert supervisor.supervisor.wait(START_S) == 0


def fill(address):
    """Leave no room for another message."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                sender.sendto(b"noise", str(address))


def goes_on(supervisor):
    """The loop still turns, longer than it takes to tell the manager twice."""
    first_s = supervisor.follow(lambda telemetry: True)[0].time_s
    supervisor.follow(lambda telemetry: telemetry.time_s > first_s + 2.5)
