"""`fitctl replay` as a stranger meets it."""

import json
import os
import signal
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from instruments.served import until
from samples.log_samples import RUN_INFO, frame, tick, write_log

from fitctl.cli import main
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import save_design
from fitctl.controllers.prefilter import Prefilter
from fitctl.messages.commands import SetController
from tests.samples.logged_simulation import LoggedSimulation


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    rig = load_rig(default_rig_path(), ["loops.right.coarse.reach_fraction=0.7"])
    simulation = LoggedSimulation(rig, path)
    simulation.acquire()
    simulation.run(3.0)
    simulation.writer.close()
    return path


@pytest.fixture(scope="module")
def changed_log(tmp_path_factory):
    """A run in which somebody changed the controller after half a minute."""
    path = tmp_path_factory.mktemp("log") / "changed.mcap"
    simulation = LoggedSimulation(load_rig(default_rig_path()), path)
    simulation.acquire()
    simulation.run(30.0)
    simulation.command(SetController(loop="right", name="minimum-variance"))
    simulation.run(35.0)
    simulation.writer.close()
    return path


@pytest.fixture
def replay(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["replay", *map(str, arguments)])
        printed = capsys.readouterr()
        return end.value.code or 0, printed.out, printed.err

    return run


def test_ones_own_log_is_the_same_and_the_status_says_so(replay, log):
    status, text, _ = replay(log)

    first, loop, _, *rows, verdict = text.splitlines()
    assert status == 0
    assert first.startswith(f"{log}: 3.0 s of rig fit-mock, replayed at ")
    assert loop == "loop right: 152 ticks"
    assert [row.split()[-1] for row in rows] == ["0"] * 5
    assert verdict == "the same, to the last bit"


def test_another_controller_differs_and_the_table_says_where_and_that_it_is_open_loop(replay, log):
    status, text, _ = replay(log, "--controller", "lqg-ltr")

    rows = {line[2:24].strip(): line[24:].split() for line in text.splitlines()}
    assert status == 0  # a change that was asked for
    assert rows["mode"] == rows["star's place"] == ["0"]
    ticks, first_s, *_, worst, unit, rms, _ = rows["D/A voltages"]
    assert (int(ticks) > 50, float(first_s) > 0.4, unit) == (True, True, "V")
    assert float(worst) > float(rms) > 0
    assert "loop right begins with controller lqg-ltr, in the log with eq20" in text
    assert "open loop: today's commands do not change the frames, which are the log's" in text


def test_a_controller_that_is_none_is_blamed_on_its_option(replay, log):
    status, _, error = replay(log, "--controller", "nosuch")

    assert status == 2
    assert error.startswith("--controller: loops.right.vernier.controller: must be one of")


def test_a_log_too_short_for_an_expected_rms_says_so(replay, log):
    _, text, _ = replay(log, "--controller", "lqg-ltr")

    assert "loop right: no expected RMS: learn: the longest piece in VERNIER at 50 Hz is" in text


@pytest.mark.long
def test_another_controller_stays_to_the_end_whatever_the_log_changed(replay, changed_log):
    _, text, _ = replay(changed_log)
    assert text.splitlines()[-1] == "the same, to the last bit"  # with the log's own change

    status, text, _ = replay(changed_log, "--controller", "eq20", "--json")
    result = json.loads(text)
    assert status == 0
    assert result["controllers_left_out"] == 1
    # The log began with eq20: until its own command, nothing differs.
    stacks = result["loops"]["right"]["differences"]["stacks_v"]
    assert 30.0 < stacks["first_s"] < 32.0


@pytest.mark.long
def test_the_rms_of_each_controller_and_of_the_wanted_one(replay, changed_log):
    status, text, _ = replay(changed_log, "--controller", "lqg-ltr", "--json")
    (loop,) = json.loads(text)["controllers"]

    assert status == 0
    assert list(loop["measured"]) == ["eq20", "minimum-variance"]
    assert list(loop["expected"]) == ["minimum-variance", "lqg-ltr"]
    for az_px, el_px in loop["measured"].values():
        assert 0.01 < az_px < 0.03
        assert 0.01 < el_px < 0.03
    # What a design was expected to leave on frames is what it left.
    left_px = max(loop["measured"]["minimum-variance"])
    assert loop["expected"]["minimum-variance"] == pytest.approx(left_px, rel=0.2)
    assert loop["true"]["minimum-variance"] < loop["true"]["lqg-ltr"] < loop["expected"]["lqg-ltr"]


@pytest.mark.long
def test_a_saved_design_goes_by_the_name_of_its_file(replay, changed_log, tmp_path):
    file = tmp_path / "mine.json"
    save_design(design_for(load_rig(default_rig_path()), "right", "fslq"), file)
    status, text, _ = replay(changed_log, "--controller", file)

    assert status == 0
    assert "expected on the same night with minimum-variance: " in text
    assert "expected on the same night with mine.json: " in text
    assert "begins with controller mine.json, in the log with eq20" in text


def test_a_run_that_differs_without_a_change_has_status_1(replay, log, monkeypatch):
    real = Prefilter.step
    monkeypatch.setattr(Prefilter, "step", lambda self, target: real(self, target + 0.01))

    status, text, _ = replay(log)
    assert status == 1
    assert "the same" not in text


def test_json_says_the_same_for_programs(replay, log):
    changed = "loops.right.coarse.reach_frames=40"
    status, text, _ = replay(log, "--json", "--set", changed)
    result = json.loads(text)
    loop = result["loops"]["right"]

    assert status == 0
    assert result["same"] is False
    assert (loop["mode"]["then"], loop["mode"]["now"]) == ("VERNIER", "COARSE")
    assert loop["mode"]["ticks"] == 30
    assert loop["differences"]["star_px"]["first_s"] is None


def test_a_dark_frame_that_is_not_in_the_log_must_be_named_by_the_user(
    replay, tmp_path, monkeypatch
):
    file, log = tmp_path / "dark.npy", tmp_path / "run.mcap"
    np.save(file, np.full((40, 40), 1000.0))
    rig = load_rig(default_rig_path(), [f"camera.dark_file={file}"])
    with monkeypatch.context() as patched:  # as an older fitctl did
        patched.setattr("fitctl.daemon.run.dark_bytes", lambda _path: None)
        simulation = LoggedSimulation(rig, log)
    simulation.acquire()
    simulation.run(0.5)
    simulation.writer.close()

    status, _, errors = replay(log)
    assert status == 2
    assert errors.count("\n") == 1
    assert f"the dark frame's name, {file};" in errors
    assert "name the dark frame with --set camera.dark_file=FILE" in errors

    status, text, _ = replay(log, "--set", f"camera.dark_file={file}")
    assert (status, text.splitlines()[-1]) == (0, "the same, to the last bit")


UNUSABLE = {
    "a file that is none": (["no-such.mcap"], "no-such.mcap: cannot be opened"),
    "another camera": (["LOG", "--set", "camera.width_px=41"], "must be those of the log"),
    "a wrong key": (["LOG", "--set", "camera.with_px=41"], "camera.with_px: unknown key"),
    **{
        f"a key of {table}": (
            ["LOG", "--set", f"{table}.any.key=1"],
            f"replay: --set {table}.any.key=1: a replay uses nothing of the table {table}; leave it out",
        )
        for table in ("plant", "mocks", "logging", "service")
    },
    "a controller that is none": (["LOG", "--controller", "pid"], "controller"),
    "a rig file that is none": (["LOG", "--rig", "no-such.toml"], "no-such.toml: no such rig file"),
    "no log at all": (["LOG", str(default_rig_path())], "is not an MCAP log"),
}


@pytest.mark.parametrize(("arguments", "said"), UNUSABLE.values(), ids=UNUSABLE.keys())
def test_what_cannot_be_replayed_is_one_line_and_status_2(replay, log, arguments, said):
    status, text, errors = replay(*(log if word == "LOG" else word for word in arguments))

    (line,) = (line for line in errors.splitlines() if "replaying" not in line)
    assert (status, text) == (2, "")
    assert said in line


@pytest.mark.parametrize("rig_json", ["nonsense", "[1]", '{"loops": 3}', '{"loops": {}}'])
def test_a_log_whose_rig_is_none_is_refused_with_a_rig_file_too(replay, tmp_path, rig_json):
    info = msgspec.structs.replace(RUN_INFO, rig_json=rig_json)
    path = write_log(tmp_path / "a.mcap", [info, tick(1)])

    status, _, error = replay(path, "--rig", default_rig_path())

    assert status == 2
    assert f"the rig in {path}: is not as fitctl records it" in error
    assert len(error.splitlines()) == 1


def test_a_log_of_no_complete_tick_is_not_called_the_same(replay, tmp_path):
    rig = load_rig(default_rig_path())
    info = msgspec.structs.replace(RUN_INFO, rig_json=rig.model_dump_json(), dark_npy=None)
    # The tick on frame 2 comes first; without that frame the log is torn there.
    path = write_log(
        tmp_path / "torn.mcap", [info, frame(1), tick(2, time_s=1.0, mode="OFF", mode_number=0)]
    )

    status, text, error = replay(path)

    assert (status, text) == (2, "")
    assert f"{path}: has no complete tick of a loop, so nothing was replayed; expected one" in error


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGHUP])
def test_a_replay_that_is_ended_leaves_no_copy_of_its_files(tmp_path, by):
    parts = [tmp_path / "first.mcap", tmp_path / "second.mcap"]
    simulation = LoggedSimulation(load_rig(default_rig_path()), parts[0])
    simulation.acquire()
    simulation.go_on_in(parts[1])
    simulation.run(60.0)
    simulation.writer.close()
    folder = tmp_path / "temporary"
    folder.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "fitctl", "replay", *map(str, parts)],
        env=os.environ | {"TMPDIR": str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    until(lambda: list(folder.glob("fitctl-replay-*/*")))

    process.send_signal(by)
    _, error = process.communicate(timeout=60)

    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert list(folder.iterdir()) == []
