"""Which rig a command reaches: never one that nobody named while another runs."""

import json
import os
import time
from contextlib import ExitStack

import pytest
from instruments.served import Served, free_port, rig_in

from fitctl import Instrument
from fitctl.cli import main
from fitctl.commands.try_out import fault
from fitctl.commissioning.asking import PROBES
from fitctl.config import ConfigError, default_rig_path
from fitctl.messages import endpoints, running
from fitctl.messages.endpoints import make_service_folder, supervisor_name
from fitctl.messages.running import running_rigs, write_running
from fitctl.mocks.bench import FaultsNow
from fitctl.processes import name_held


@pytest.fixture
def night(monkeypatch, tmp_path):
    """Starts supervisors of this test alone; returns them."""
    prefix = f"fitctl-test:{os.getpid()}:"
    monkeypatch.setattr(endpoints, "supervisor_names", lambda: prefix)
    monkeypatch.setattr(running, "supervisor_names", lambda: prefix)
    monkeypatch.delenv("FITCTL_RIG", raising=False)
    with ExitStack() as stack:

        def start(*names):
            started = []
            for name in names:
                folder = tmp_path / name
                folder.mkdir()
                served = Served(folder, f"name={name}")
                stack.callback(served.close)
                served.start()
                stack.enter_context(name_held(supervisor_name(served.folder)))
                settings = [f"name={name}", f"service.folder={served.folder}"]
                write_running(served.folder, name, default_rig_path(), settings)
                started.append(served)
            return started

        yield start


@pytest.fixture
def fitctl(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(list(arguments))
        printed = capsys.readouterr()
        return end.value.code, printed.out, printed.err

    return run


def test_the_one_that_runs_is_meant_and_not_the_shipped_rig(night, fitctl):
    (served,) = night("night")

    status, out, err = fitctl("send", "stop")

    assert (status, out) == (0, "right SAFE\n")
    assert "rig night: " in err
    assert [accepted for _, accepted in served.commands("Stop")] == [True]


def test_where_several_run_a_command_names_them_and_does_nothing(night, fitctl):
    both = night("north", "south")

    status, out, err = fitctl("send", "standby")

    assert (status, out) == (2, "")
    for served in both:
        assert f"{served.rig.name} (process {os.getpid()})" in err
        assert f"--set service.folder={served.folder}" in err
        assert served.commands("Standby") == []


def test_where_several_run_stop_stops_all_of_them_and_says_so(night, fitctl):
    both = night("north", "south")

    status, out, err = fitctl("send", "stop")

    assert (status, out) == (0, "right SAFE\n" * 2)
    assert "2 supervisors run; stopping all of them" in err
    assert "rig north: " in err
    assert "rig south: " in err
    for served in both:
        assert [accepted for _, accepted in served.commands("Stop")] == [True]


def test_one_that_hangs_does_not_keep_the_others_from_being_stopped(night, fitctl):
    hung, well = night("hung", "well")
    hung.ending.set()
    hung.stepper.join()

    begun_s = time.monotonic()
    status, _, err = fitctl("send", "stop")

    assert status == 1
    assert f"(process {os.getpid()}) runs, but did not answer within 2 s" in err
    assert "the instrument may still move: cut its power" in err
    assert [accepted for _, accepted in well.commands("Stop")] == [True]
    assert time.monotonic() - begun_s < 4.0


@pytest.mark.parametrize(
    "command",
    [
        ["send", "stop"],
        ["send", "status"],
        ["status"],
        ["sequence", "pause"],
        ["sequence", "dry-run", "acquire", "--present"],
        ["watch"],
    ],
    ids=" ".join,
)
def test_where_none_runs_there_is_one_line(night, fitctl, command):
    night()

    status, out, err = fitctl(*command)

    assert (status, out) == (3, "")
    assert len(err.splitlines()) == 1
    assert f"{command[0]}: you have no supervisor running" in err


def test_the_environment_names_the_rig_before_the_one_that_runs(
    night, fitctl, monkeypatch, tmp_path
):
    (runs,) = night("night")
    file = tmp_path / "mine.toml"
    file.write_text(
        f'base = "{default_rig_path()}"\nname = "mine"\nservice.folder = "{tmp_path / "none"}"\n'
    )
    monkeypatch.setenv("FITCTL_RIG", str(file))

    status, _, err = fitctl("send", "stop")

    assert status == 1
    assert "rig mine: " in err
    assert runs.commands("Stop") == []


def test_status_as_json_prints_which_rig_on_the_error_output(night, fitctl):
    night("night")

    _, out, err = fitctl("status", "--json")

    assert out.startswith("{")
    assert len(out.splitlines()) == 1
    assert "rig night: " in err


def test_an_option_names_one_of_several(night, fitctl):
    north, south = night("north", "south")
    at = ["--set", "name=south", "--set", f"service.folder={south.folder}"]

    status, out, _ = fitctl("send", "stop", "--rig", str(default_rig_path()), *at)

    assert (status, out) == (0, "right SAFE\n")
    assert north.commands("Stop") == []


def test_a_supervisor_that_was_killed_does_not_count(night, tmp_path):
    folder = make_service_folder(rig_in(tmp_path))
    write_running(folder, "dead", default_rig_path(), [])

    night("night")

    assert [rig.name for rig in running_rigs()] == ["night"]


def test_a_name_that_leads_to_another_users_folder_is_not_believed(night, tmp_path, monkeypatch):
    night("night")
    folder = make_service_folder(rig_in(tmp_path))
    write_running(folder, "false", default_rig_path(), [])
    folder.chmod(0o755)  # no longer ours alone

    with name_held(supervisor_name(folder)):
        assert [rig.name for rig in running_rigs()] == ["night"]


@pytest.fixture
def asked(monkeypatch):
    """Which benches are asked, and as which rigs; nothing is wrong with any."""
    benches = []

    def ask(port, question, _answer):
        benches.append((port, question.rig))
        return FaultsNow([], "", question.rig)

    monkeypatch.setattr(fault, "ask_bench", ask)
    return benches


def with_bench(served):
    """Its mocks listen on a port that only it knows."""
    port, name = free_port(), served.rig.name
    at = [f"name={name}", f"service.folder={served.folder}", f"mocks.bench_port={port}"]
    write_running(served.folder, name, default_rig_path(), at)
    return port


def test_faults_go_to_the_mocks_of_the_one_that_runs(night, fitctl, asked):
    (served,) = night("night")
    port = with_bench(served)

    status, out, err = fitctl("fault", "now")

    assert (status, out) == (0, "all is well\n")
    assert asked == [(port, "night")]
    assert "rig night: " in err


def test_faults_go_to_the_mocks_of_the_one_in_the_folder_that_is_given(night, fitctl, asked):
    ports = {served.rig.name: (served, with_bench(served)) for served in night("north", "south")}
    served, port = ports["south"]
    at = ["--rig", str(default_rig_path()), "--set", f"service.folder={served.folder}"]

    fitctl("fault", "now", *at)
    fitctl("fault", "now", *at, "--set", "mocks.bench_port=1")

    assert asked == [(port, "south"), (1, "fit-mock")]


def test_where_several_run_a_fault_names_them_and_does_nothing(night, fitctl):
    night("north", "south")

    status, _, err = fitctl("fault", "set", "camera", "drop")

    assert status == 2
    assert "2 supervisors run; nothing was done" in err


def test_the_shipped_rig_is_still_the_one_that_is_computed_with(night, fitctl):
    night("night")

    status, out, _ = fitctl("check")

    assert status == 0
    assert "rig fit-mock" in out


# ---------------------------------------------------------------- from Python


def test_an_instrument_without_a_rig_is_the_one_that_runs(night):
    (served,) = night("night")

    with Instrument() as instrument:
        assert instrument.rig.name == "night"
        instrument.stop()

    assert [accepted for _, accepted in served.commands("Stop")] == [True]


def test_an_instrument_without_a_rig_names_those_that_run(night):
    both = night("north", "south")

    with pytest.raises(ConfigError, match="2 supervisors run; nothing was done") as several:
        Instrument()

    for served in both:
        assert f"{served.rig.name} (process {os.getpid()})" in str(several.value)


def test_an_instrument_without_a_rig_where_none_runs_says_so(night):
    night()

    with pytest.raises(ConnectionError, match="you have no supervisor running"):
        Instrument()


def test_the_environment_names_the_rig_of_an_instrument(night, monkeypatch, tmp_path):
    night("night")
    file = tmp_path / "mine.toml"
    file.write_text(
        f'base = "{default_rig_path()}"\nname = "mine"\nservice.folder = "{tmp_path / "none"}"\n'
    )
    monkeypatch.setenv("FITCTL_RIG", str(file))

    with pytest.raises(ConnectionError, match=f"no supervisor answers at {tmp_path / 'none'}"):
        Instrument()
    with Instrument(simulate=True) as instrument:
        assert instrument.rig.name == "mine"


def test_a_stop_for_any_loop_is_sent_to_the_rig_that_is_named(night, fitctl):
    """Its supervisor may know loops that the file no longer has."""
    (served,) = night("night")
    settings = ("--set", "name=night", "--set", f"service.folder={served.folder}")

    status, _, err = fitctl("send", "stop", "--loop", "gone", *settings)
    assert status == 1
    assert "no loop is named gone; the rig has right" in err


def test_a_command_reaches_a_metrology_loop_of_the_file_that_is_named(fitctl, tmp_path):
    testbed = str(default_rig_path().with_name("fit-testbed.toml"))
    folder = f"service.folder={tmp_path / 'nobody'}"

    status, _, err = fitctl("send", "off", "--loop", "metrology", "--rig", testbed, "--set", folder)
    assert status == 1
    assert "no supervisor answers" in err


@pytest.fixture
def no_device(monkeypatch):
    """A device that doctor queries is an error."""

    def query(_settings):
        pytest.fail("doctor queried a device of a running supervisor")

    for driver in PROBES:
        monkeypatch.setitem(PROBES, driver, query)


@pytest.mark.usefixtures("no_device")
def test_doctor_queries_no_device_of_a_supervisor_in_another_folder(night, fitctl):
    night("night")

    _, out, _ = fitctl("doctor", "--json", "--set", "name=night")
    assert json.loads(out)["asked"] == "supervisor"


@pytest.mark.usefixtures("no_device")
def test_doctor_queries_no_device_of_a_supervisor_that_hangs(night, fitctl, tmp_path):
    night()
    folder = make_service_folder(rig_in(tmp_path))
    write_running(folder, "fit-mock", default_rig_path(), [f"service.folder={folder}"])
    with name_held(supervisor_name(folder)):
        status, _, err = fitctl("doctor", "--json")
    assert status == 1
    assert "The devices were not queried, because that would disturb it" in err
