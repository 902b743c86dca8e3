"""`fitctl doctor` and `fitctl discover` as a stranger meets them."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from instruments.served import Served

from fitctl.cli import main
from fitctl.commissioning.asking import PROBES
from fitctl.config import default_rig_path
from fitctl.drivers.interface import DeviceIdentity
from fitctl.drivers.probe import Probe
from fitctl.messages import endpoints
from fitctl.messages.commands import Standby

TESTBED = default_rig_path().with_name("fit-testbed.toml")
PORTS_WITHOUT_MOCKS = [
    part
    for setting in (
        "camera.device.gvcp_port=1",
        "camera.device.response_timeout_s=0.1",
        "loops.right.siderostat.device.channel=socket://127.0.0.1:1",
        "loops.right.fsm.dac.port=1",
        "loops.right.fsm.piezo.port=socket://127.0.0.1:2",
    )
    for part in ("--set", setting)
]


@pytest.fixture(scope="module")
def mocks():
    """Where mock devices listen, as --set arguments."""
    with listening() as endpoints:
        yield endpoints


@contextmanager
def listening(*arguments):
    process = subprocess.Popen(
        [sys.executable, "-m", "fitctl", "mocks", "--free-ports", "--json", *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        endpoints = json.loads(process.stdout.readline())
        yield [
            part
            for key, value in endpoints.items()
            if not key.startswith("mocks.")
            for part in ("--set", f"{key}={value}")
        ]
    finally:
        process.terminate()
        process.communicate(timeout=30)


@pytest.fixture
def doctor(capsys, monkeypatch, tmp_path):
    # A demo that runs beside the tests would have the shipped rig's folder.
    monkeypatch.setattr(endpoints, "_own_folder", lambda: tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["doctor", *arguments])
        return end.value.code or 0, capsys.readouterr().out

    return run


def devices(out):
    return {one["device"]: one for one in json.loads(out)["devices"]}


def test_every_device_says_who_it_is_and_how_soon(doctor, mocks):
    status, out = doctor("--json", *mocks)
    assert json.loads(out)["asked"] == "devices"
    found = devices(out)
    assert [one["disagreements"] for one in found.values()] == [[]] * 4
    assert status == 0
    assert list(found) == ["camera", "right siderostat", "right D/A", "right piezo amplifier"]
    for one in found.values():
        assert one["found"]
        assert one["identity"]["model"]
        assert one["identity"]["firmware"]
        assert one["round_trip_ms"] > 0
    assert found["right piezo amplifier"]["round_trip_ms"] > 30  # after which it answers


@pytest.fixture
def testbed(tmp_path):
    """The testbed's rig, without a supervisor."""
    return ["--rig", str(TESTBED), "--set", f"service.folder={tmp_path / 'none'}"]


@pytest.mark.long
def test_the_testbed_has_photodiodes_and_a_hexapod_too(doctor, testbed):
    with listening("--rig", str(TESTBED)) as endpoints:
        status, out = doctor("--json", *testbed, *endpoints)
    found = devices(out)
    assert status == 1
    assert found["metrology photodiodes"]["identity"]["model"] == "T7"
    assert "C-887" in found["hexapod"]["identity"]["model"]
    assert len(found) == 10
    complaints = {
        device: one["disagreements"] for device, one in found.items() if one["disagreements"]
    }
    assert list(complaints) == ["hexapod"]
    assert "not referenced" in complaints["hexapod"][0]


def test_drives_on_one_adapter_that_serves_one_client_are_all_found(doctor, testbed, monkeypatch):
    at_once, most = [], []

    def probe(siderostat):
        at_once.append(siderostat)
        time.sleep(0.05)
        most.append(len(at_once))
        at_once.remove(siderostat)
        return Probe(DeviceIdentity("", f"node {siderostat.device.node_id}", "", ""), 0.001)

    monkeypatch.setitem(PROBES, "cia402", probe)
    on_one_bus = [
        f"loops.{loop}.siderostat.device.{setting}"
        for node, loop in enumerate(("right", "metrology", "left"), 1)
        for setting in (f"node_id={node}", "channel=socket://127.0.0.1:1")
    ]
    _, out = doctor("--json", *testbed, *(part for each in on_one_bus for part in ("--set", each)))
    found = [one for device, one in devices(out).items() if device.endswith("siderostat")]
    assert [one["identity"]["model"] for one in found] == ["node 1", "node 2", "node 3"]
    assert most == [1, 1, 1]


def test_people_get_a_table_that_fits_their_terminal(doctor, mocks):
    status, out = doctor(*mocks)
    assert status == 0
    assert max(map(len, out.splitlines())) <= 118
    assert "MDT693B" in out


def test_what_is_not_as_the_rig_file_says_is_told_with_what_to_do(doctor, mocks):
    fsm = "loops.right.fsm"
    other = (f"{fsm}.piezo.limit_v=100.5", f"{fsm}.bias_v=3.33", f"{fsm}.range_rad=1.181e-4")
    status, out = doctor("--json", *mocks, *(part for each in other for part in ("--set", each)))
    (told,) = devices(out)["right piezo amplifier"]["disagreements"]
    assert status == 1
    assert devices(out)["right piezo amplifier"]["found"]
    assert "expected the voltage-limit switch at 100.5 V, got 150 V" in told
    assert "set the voltage-limit switch" in told


def test_what_is_not_there_is_not_found_and_told_where_it_was_looked_for(doctor, mocks):
    status, out = doctor("--json", *mocks, "--set", "loops.right.fsm.dac.port=1")
    found = devices(out)
    assert status == 1
    assert not found["right D/A"]["found"]
    assert "127.0.0.1:1" in found["right D/A"]["disagreements"][0]
    assert found["camera"]["found"]


def test_mocks_that_are_not_started_are_no_failure_of_the_hardware(doctor, tmp_path):
    away = ("--set", f"service.folder={tmp_path / 'none'}", *PORTS_WITHOUT_MOCKS)
    status, out = doctor("--json", *away)
    found = devices(out)
    assert status == 0
    assert not any(one["found"] or one["disagreements"] for one in found.values())
    assert all("fitctl mocks" in one["note"] for one in found.values())

    status, out = doctor("--json", *away, "--set", "loops.right.fsm.piezo.port=/dev/no-such-port")
    found = devices(out)
    assert status == 1
    assert [device for device, one in found.items() if one["disagreements"]] == [
        "right piezo amplifier"
    ]


def test_asking_changes_nothing(doctor, mocks):
    first, again = (doctor("--json", *mocks)[1] for _ in range(2))
    identities = [[one["identity"] for one in devices(out).values()] for out in (first, again)]
    assert identities[0] == identities[1]


# ---------------------------------------------------------------- beside a running supervisor


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A running supervisor; a device that doctor asks all the same is an error."""

    def ask(_settings):
        pytest.fail("doctor asked a device of a running supervisor")

    for driver in PROBES:
        monkeypatch.setitem(PROBES, driver, ask)
    served = Served(tmp_path)
    served.start()
    yield served
    served.close()


def of_rig(served):
    return ["--set", f"service.folder={served.folder}"]


def test_beside_a_running_supervisor_its_report_is_printed_and_no_device_asked(doctor, served):
    assert served.client.send(Standby()).accepted
    assert served.follow(lambda message: message.loops[0].mode == "STANDBY")
    assert served.follow(lambda message: {one.state for one in message.devices} == {"ok"})
    _, out = doctor("--json", *of_rig(served))
    document = json.loads(out)
    assert document["asked"] == "supervisor"
    found = devices(out)
    assert found["right siderostat"]["driver"] == "cia402"
    assert found["right siderostat"]["found"]
    assert found["right siderostat"]["disagreements"] == []
    _, table = doctor(*of_rig(served))
    assert f"runs (process {os.getpid()})" in " ".join(table.split())


def test_devices_that_the_running_supervisor_has_not_opened_are_not_found(doctor, served):
    status, out = doctor("--json", *of_rig(served))
    (complaint,) = devices(out)["right siderostat"]["disagreements"]
    assert "has not opened it" in complaint
    assert status == 1


@pytest.mark.long
def test_a_socket_that_a_supervisor_left_behind_keeps_nobody_from_asking(doctor, mocks, tmp_path):
    folder = tmp_path / "s"
    folder.mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(folder / "command"))
    status, out = doctor("--json", *mocks, "--set", f"service.folder={folder}")
    assert json.loads(out)["asked"] == "devices"
    assert status == 0


@pytest.mark.long
@pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("unshare"), reason="needs root and unshare"
)
def test_a_camera_alone_in_its_network_is_discovered(tmp_path):
    """The broadcast leaves on every interface: in here there is none but loopback."""
    program = (
        "ip link set lo up || exit 77\n"
        f"{sys.executable} -m fitctl mocks --set mocks.gvcp_port=3956 --set mocks.bench_port=0 --json"
        " >mocks.out & mocks=$!\n"
        "for i in $(seq 100); do [ -s mocks.out ] && break; sleep 0.1; done\n"
        f"{sys.executable} -m fitctl discover --broadcast 127.0.0.1 --timeout 2 --json; status=$?\n"
        "kill $mocks; wait $mocks; exit $status\n"
    )
    result = subprocess.run(
        ["unshare", "-n", "sh", "-c", program],
        check=False,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
    )
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no network namespace: {result.stderr.strip()}")
    assert result.returncode == 0, result.stderr
    (camera,) = json.loads(result.stdout)["cameras"]
    assert camera["model"] == "MockCamera"
    assert camera["address"] == "127.0.0.1"
