"""`fitctl send --wait` follows a command to its end, says in one line how it ended, and so does its status."""

import os
import signal
import threading
from functools import partial

import pytest
from instruments.served import until
from instruments.simulated import darken, failing

from fitctl.commands.operate import send
from fitctl.commands.shared import supervisor as addressing
from fitctl.drivers.interface import DeviceTimeout
from fitctl.messages.commands import Acquire, Standby, Stop
from fitctl.messages.modes import Mode

WIDE = "search_radius_sky_arcsec=1100"  # a search that goes on for minutes
SILENT = DeviceTimeout("piezo right", "/dev/ttyUSB0", "an answer in 1 s", "none", "is it on?")


@pytest.fixture
def broken(served, monkeypatch):
    piezo = served.simulation.devices.loops["right"].piezo
    monkeypatch.setattr(piezo, "open", failing(SILENT))


@pytest.fixture
def meanwhile(monkeypatch):
    """Has something done, on a thread, once a command waits."""

    def plan(action, *arguments):
        def before(wait, *given):
            threading.Thread(target=action, args=arguments).start()
            return wait(*given)

        for name in ("wait_for_outcomes", "wait_for_end"):
            monkeypatch.setattr(addressing, name, partial(before, getattr(addressing, name)))

    return plan


def test_it_waits_until_what_was_asked_for_has_happened(fitctl):
    status, out, err = fitctl("send", "standby", "--wait")

    assert status == 0
    accepted, happened = out.splitlines()
    assert accepted == "accepted"
    assert happened.startswith("right STANDBY: all devices open, checked and enabled (after ")
    assert "Ctrl-C ends the waiting, not the command" in err


def test_a_failure_is_one_line_with_the_reason_and_status_1(fitctl, broken):
    status, out, err = fitctl("send", "standby", "--wait")

    assert (status, out) == (1, "accepted\n")
    (line,) = (line for line in err.splitlines() if line.startswith("right: "))
    assert "standby failed after" in line
    assert str(SILENT) in line


def test_a_script_that_does_not_wait_gets_the_answer_alone(fitctl, broken):
    assert fitctl("send", "standby")[:2] == (0, "accepted\n")


def test_on_a_terminal_it_waits_unless_told_not_to(fitctl, broken, monkeypatch):
    monkeypatch.setattr(send, "has_terminal", lambda: True)

    assert fitctl("send", "standby")[0] == 1
    assert fitctl("send", "standby", "--no-wait")[0] == 0


def test_what_is_still_under_way_after_the_timeout_has_a_status_of_its_own_and_goes_on(
    fitctl, served
):
    fitctl("send", "standby", "--wait")
    darken(served.simulation)

    status, _, err = fitctl("send", "acquire", WIDE, "--timeout", "0.3")

    assert status == 4
    assert "right: acquire is still under way after 0.3 s, and continues" in err
    assert served.simulation.supervisor.loops["right"].mode is Mode.ACQUISITION


def test_ctrl_c_ends_the_waiting_and_not_the_command(fitctl, served, meanwhile):
    fitctl("send", "standby", "--wait")
    darken(served.simulation)
    meanwhile(os.kill, os.getpid(), signal.SIGINT)

    status, _, err = fitctl("send", "acquire", WIDE, "--wait")

    assert status == 130
    assert "no longer waiting; acquire continues" in err
    assert served.simulation.supervisor.loops["right"].mode is Mode.ACQUISITION


def test_a_stop_by_another_ends_the_waiting_as_a_failure(fitctl, served, meanwhile):
    fitctl("send", "standby", "--wait")
    darken(served.simulation)
    meanwhile(served.client_of(served.folder).send, Stop())

    status, _, err = fitctl("send", "acquire", WIDE, "--wait")

    assert status == 1
    assert "stop ended the search" in err


def test_what_is_refused_or_takes_no_time_is_not_waited_for(fitctl):
    status, _, err = fitctl("send", "acquire", "--wait")
    assert status == 1
    assert "acquire is not available in OFF" in err
    assert fitctl("send", "stop", "--wait")[:2] == (0, "right SAFE\n")


@pytest.mark.parametrize("timeout", ["0", "soon"])
def test_a_timeout_that_is_none_is_status_2(fitctl, timeout):
    assert fitctl("send", "standby", "--timeout", timeout)[0] == 2


@pytest.mark.long
def test_a_supervisor_that_dies_meanwhile_is_said(fitctl, served, meanwhile):
    fitctl("send", "standby", "--wait")
    darken(served.simulation)
    meanwhile(served.service.stop)

    status, _, err = fitctl("send", "acquire", WIDE, "--wait")

    assert status == 1
    assert "no telemetry for 5 s" in err


def test_shutdown_waits_until_the_supervisor_has_ended(fitctl, served, monkeypatch, meanwhile):
    runs = [True]
    monkeypatch.setattr("fitctl.messages.waiting.supervisor_runs", lambda _folder: runs[0])

    def end():
        served.service.stop()
        until(lambda: served.client.receive(0.1) is None)
        runs[0] = False

    meanwhile(end)
    status, out, _ = fitctl("send", "shutdown", "--wait")

    assert (status, out) == (0, "shutting down\nthe supervisor has ended\n")


def test_a_failed_command_is_followed_in_each_loop_by_name(served, broken):
    reply = served.client.send(Standby())

    found = addressing.wait_for_outcomes(served.client, reply, 10.0)

    assert {loop: each.state for loop, each in found.items()} == {"right": "failed"}
    assert served.client.send(Acquire()).number == 0
