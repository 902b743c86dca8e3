"""`fitctl log summary` prints a line for each log as it is read, also of one that cannot be read."""

import json

import pytest
from samples.log_samples import RUN_INFO, tick, write_log
from samples.logged_simulation import designs_of
from samples.report_samples import record

from fitctl.cli import main
from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.run import run_info


@pytest.fixture
def log(tmp_path):
    def held(simulation):
        simulation.acquire()
        simulation.run(60.0)

    path = tmp_path / "held.mcap"
    record(load_rig(default_rig_path()), path, held)
    return path


def printed(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main(["log", "summary", *map(str, arguments)])
    return end.value.code, capsys.readouterr().out.splitlines()


@pytest.mark.long
def test_start_duration_rms_and_verdict_are_printed(log, tmp_path, capsys):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:200])
    status, lines = printed(capsys, "--json", log, torn, tmp_path / "none.mcap")
    held, cut, none = map(json.loads, lines)
    assert status == 2
    assert held["verdict"] == "met"
    assert held["duration_s"] == pytest.approx(60.0, abs=1.0)
    rms, unit = held["rms"]["right"].split()
    assert 0.005 < float(rms) < 0.1
    assert unit == "px"
    assert cut["verdict"] == "not known"
    assert "none.mcap" in none["error"]


@pytest.mark.long
def test_a_log_that_is_too_large_is_only_named(log, capsys):
    status, (line,) = printed(capsys, "--json", "--most-bytes", "1000", log)
    assert not status
    known = json.loads(line)
    assert known["error"] == "too large to be read here"
    assert known["duration_s"] > 50
    assert known["rms"] == {}


@pytest.mark.long
def test_a_line_for_people_has_them_too_beside_a_log_that_is_missing(log, tmp_path, capsys):
    status, (line,) = printed(capsys, tmp_path / "none.mcap", log)
    assert status == 2
    assert "requirement met: right 0.0" in line


def test_a_log_whose_rig_is_of_another_version_does_not_end_the_list(tmp_path, capsys):
    old = write_log(tmp_path / "old.mcap", [RUN_INFO, tick(1)])
    status, lines = printed(capsys, "--json", old, tmp_path / "none.mcap")
    assert status == 2
    first, second = (json.loads(line)["error"] for line in lines)
    assert "old.mcap: rig file in it" in first
    assert "none.mcap" in second


def test_a_log_without_records_has_no_start(tmp_path, capsys):
    rig = load_rig(default_rig_path())
    path = write_log(
        tmp_path / "zero.mcap", [run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))]
    )

    assert printed(capsys, path) == (0, [f"{path}: without any record, requirement not known"])
