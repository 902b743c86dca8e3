"""Which supervisor a command reaches when none is named, over real processes: `fitctl run` and `fitctl demo`.

The names by which they find each other begin with the test's own here: a stop that is for all supervisors of
this user would otherwise stop those of other tests.
"""

import signal

import pytest

from fitctl.daemon.locks import only_supervisor
from fitctl.messages.commands import Status

from .conftest import START_S, Rig, absent_devices, end


@pytest.fixture
def start(own_names, tmp_path):
    """Starts supervisors of rigs of these names, without devices: they are OFF."""
    rigs = []

    def begin(*names):
        for name in names:
            (tmp_path / name).mkdir()
            rig = Rig(tmp_path / name)
            rig.endpoints = absent_devices()
            rig.settings.append(f"name={name}")
            rig.before = own_names
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
