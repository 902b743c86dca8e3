"""`fitctl sequence` as a stranger meets it."""

import json
import os
from pathlib import Path

import pytest
import tomli_w

from fitctl.cli import main
from fitctl.config import default_rig_path
from fitctl.messages import endpoints, running
from fitctl.sequences.files import shipped_sequences
from fitctl.sequences.runner import Runner

HEAD = 'schema_version = 1\nname = "tried"\ndescription = "Of a test."\n'
WAIT = HEAD + 'steps = [{ step = "wait", duration_s = 5.0 }]\n'


@pytest.fixture
def sequence(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["sequence", *map(str, arguments)])
        said = capsys.readouterr()
        return end.value.code or 0, said.out, said.err

    return run


def written(tmp_path, text):
    path = tmp_path / "tried.toml"
    path.write_text(text)
    return path


def test_the_shipped_sequences_are_listed(sequence):
    status, out, _ = sequence("list")

    assert status == 0
    listed = [line.split()[0] for line in out.splitlines()]
    assert listed == [path.stem for path in shipped_sequences()]


def test_sequences_are_listed_with_every_key_for_programs(sequence, tmp_path):
    status, out, _ = sequence("list", "--json")
    assert status == 0
    jog = next(each for each in json.loads(out) if each["name"] == "dither")
    assert Path(jog["file"]).is_file()
    assert jog["steps"][2]["dither_px"] == 1.0
    assert jog["steps"][0]["attempts"] == 2  # not in the file

    path = written(tmp_path, WAIT)
    (mine,) = json.loads(sequence("list", "--json", path)[1])
    assert (mine["file"], mine["steps"][0]["duration_s"]) == (str(path), 5.0)

    copy = {key: value for key, value in jog.items() if key != "file"}
    path.write_text(tomli_w.dumps(copy))  # what is listed is a sequence again
    assert sequence("check", path)[0] == 0


def test_a_list_of_stars_from_a_file_is_listed_so_that_it_can_be_read_again(sequence, tmp_path):
    (listed,) = json.loads(sequence("list", "--json", "stars")[1])
    copy = {key: value for key, value in listed.items() if key != "file"}
    path = tmp_path / "tried.toml"
    path.write_text(tomli_w.dumps(copy))

    rig = default_rig_path().parent / "star-field.toml"
    assert sequence("check", path, "--rig", rig)[0] == 0
    (again,) = json.loads(sequence("list", "--json", path)[1])
    assert again["steps"] == listed["steps"]
    assert [star["name"] for star in again["steps"][0]["stars"]][:2] == ["alpha", "beta"]


def test_a_shipped_sequence_is_listed_by_its_name(sequence):
    status, out, _ = sequence("list", "dither", "hold")

    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == ["dither", "hold"]


def test_check_says_every_mistake_on_a_line(sequence, tmp_path):
    path = written(
        tmp_path, HEAD + 'steps = [{ step = "hold" }, { step = "dither", dither_px = 4.0 }]\n'
    )
    status, out, err = sequence("check", path)

    assert status == 2
    assert out == ""
    assert err.splitlines() == [f"{path}: step 1 (hold): duration_s: is missing"]

    path.write_text(path.read_text().replace('"hold"', '"hold", duration_s = 1.0'))
    status, _, err = sequence("check", path)
    assert status == 2
    assert len(err.splitlines()) == 1
    assert "step 2 (dither): the star would go 5.66 px" in err


def test_check_tells_what_is_well(sequence):
    status, out, _ = sequence("check", "dither")

    assert status == 0
    assert "well; 3 steps for rig fit-mock" in out


@pytest.mark.parametrize("command", ["check", "dry-run", "run"])
def test_a_file_that_is_not_there_is_told_with_those_that_are(sequence, command):
    status, _, err = sequence(command, "jgo")

    assert status == 2
    assert "no such sequence file" in err
    assert "dither" in err


def test_a_dry_run_prints_every_attempt_and_the_virtual_time(sequence, tmp_path):
    status, out, _ = sequence("dry-run", written(tmp_path, WAIT))

    assert status == 0
    head, wait, time = out.splitlines()
    assert "outcome" in head
    assert wait.split()[:4] == ["1", "wait", "1", "done"]
    assert float(time.split()[0]) == pytest.approx(5.0, abs=0.5)


def test_set_changes_the_sequence_and_the_rig(sequence, tmp_path):
    path = written(tmp_path, WAIT)

    status, out, _ = sequence(
        "dry-run", path, "--set", "steps.wait.duration_s=20", "--set", "name=other"
    )

    assert status == 0
    assert float(out.splitlines()[-1].split()[0]) == pytest.approx(20.0, abs=0.5)
    assert "for rig other" in sequence("check", path, "--set", "name=other")[1]


@pytest.fixture
def nothing_runs(monkeypatch, tmp_path):
    """No supervisor runs, whatever this machine does beside the test."""
    monkeypatch.delenv("FITCTL_RIG", raising=False)
    monkeypatch.setattr(endpoints, "_own_folder", lambda: tmp_path)
    monkeypatch.setattr(running, "supervisor_names", lambda: f"fitctl-test:{os.getpid()}:")


@pytest.mark.parametrize("command", [["run"], ["dry-run", "--present"]])
def test_set_gives_what_the_file_lacks_also_on_the_instrument(
    sequence, nothing_runs, tmp_path, command
):
    path = written(tmp_path, HEAD + 'steps = [{ step = "wait" }]\n')
    assert sequence(*command, path)[::2] == (2, f"{path}: step 1 (wait): duration_s: is missing\n")

    status, _, err = sequence(*command, path, "--set", "steps.1.duration_s=2")

    assert status == 3  # the sequence has no mistake; what it is for does not run
    assert "you have no supervisor running" in err


@pytest.mark.parametrize("command", [["run", "dither"], ["pause"], ["resume"], ["end"]])
def test_where_no_supervisor_runs_and_no_rig_is_named_the_status_is_3(
    sequence, nothing_runs, command
):
    status, _, err = sequence(*command)

    assert status == 3
    assert "you have no supervisor running" in err


def test_a_dry_run_that_fails_has_status_1_and_says_why(sequence, tmp_path):
    path = written(tmp_path, HEAD + 'steps = [{ step = "hold", duration_s = 1.0, attempts = 2 }]\n')
    status, out, err = sequence("dry-run", path, "--json")

    assert status == 1
    told = json.loads(out)
    assert [attempt["outcome"] for attempt in told["attempts"]] == ["failed", "failed"]
    assert told["attempts"][0]["figures"] == {}
    assert "hold needs VERNIER" in told["failure"]
    assert err.splitlines()[-1] == f"sequence tried: {told['failure']}"


def test_an_interrupt_keeps_what_was_measured_before_it(sequence, tmp_path, monkeypatch):
    run = Runner.run

    def interrupted(self, step):
        if step.step == "wait":
            raise KeyboardInterrupt
        return run(self, step)

    monkeypatch.setattr(Runner, "run", interrupted)
    steps = (
        'steps = [{ step = "standby" }, { step = "dark" }, { step = "wait", duration_s = 5.0 }]\n'
    )
    path = written(tmp_path, HEAD + steps)
    status, out, _ = sequence("dry-run", path, "--out", tmp_path)

    assert status == 130
    (fragment,) = tmp_path.glob("*-dark.toml")
    assert f"written: {fragment}" in out


@pytest.mark.parametrize("command", [["run", "dither"], ["end"]])
def test_without_a_supervisor_there_is_one_line_and_status_1(sequence, tmp_path, command):
    status, _, err = sequence(*command, "--set", f"service.folder={tmp_path / 'none'}")

    assert status == 1
    assert "no supervisor answers" in err.splitlines()[-1]
