"""`fitctl identify` as a stranger meets it: what is wrong is said before anything moves."""

import os
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest
from samples.log_samples import RUN_INFO, one_of_each, write_log

from fitctl.cli import main
from fitctl.commands.design import identify as commands
from fitctl.daemon.run import run_info
from fitctl.identify import run as runs
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.identify.run import on_simulation
from fitctl.logging.writer import LogWriter
from fitctl.messages.commands import Experiment, Release, Reply
from fitctl.model.drives import Drive

WALL_S = 1_795_000_000.0


@pytest.fixture
def identify(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["identify", *map(str, arguments)])
        return end.value.code or 0, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--plot", "a.xyz"], "a.xyz"),
        (["--out", "nowhere/a.toml"], "nowhere/a.toml"),
        (["--plot", "nowhere/a.png"], "nowhere/a.png"),
        (["--out", "."], "nothing can be written"),
        (["--out", "a.png"], "both the fragment and the plot"),
        (["--mocks"], "exclude each other"),
        (["--log", "a.mcap"], "exclude each other"),
        (["--loop", "left"], "left"),
    ],
)
def test_what_could_not_end_well_is_not_begun(identify, monkeypatch, tmp_path, arguments, said):
    monkeypatch.setattr(commands, "on_simulation", lambda *_: pytest.fail("it was begun"))
    status, err = identify("delay", "--simulate", *arguments)
    assert status == 2
    assert said in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("head", "is_refused"),
    [
        ("schema_version = 2\n", True),
        (
            "# Written by `fitctl identify delay` for rig a",
            True,
        ),  # measured, which a simulation is not
        ("# Written by `fitctl identify delay --simulate` for rig a", False),
    ],
)
def test_only_a_fragment_of_its_own_kind_is_replaced(
    identify, monkeypatch, tmp_path, head, is_refused
):
    def begun(*_):
        msg = "begun"
        raise IdentifyError(msg)

    monkeypatch.setattr(commands, "on_simulation", begun)
    mine = tmp_path / "mine.toml"
    mine.write_text(head)

    status, err = identify("delay", "--simulate", "--out", mine)

    assert mine.read_text() == head
    assert status == (2 if is_refused else 1)
    assert (
        "exists already, and was not written by fitctl identify delay --simulate" in err
    ) is is_refused


@pytest.mark.parametrize("what", sorted(EXPERIMENTS))
def test_a_log_from_which_nothing_can_be_learned_is_named(identify, tmp_path, what):
    write_log(tmp_path / "night.mcap", [RUN_INFO, *one_of_each()])

    status, err = identify(what, "--log", "night.mcap")

    assert status == 2
    assert err.count("night.mcap: ") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["night.mcap"]


def test_the_help_names_every_experiment(capsys):
    with pytest.raises(SystemExit):
        main(["identify", "--help"])
    printed = capsys.readouterr().out
    assert not [name for name in EXPERIMENTS if name not in printed]


@pytest.mark.long
def test_an_experiment_during_which_another_log_began_is_read_from_both(rig, tmp_path):
    """Each log has a part of the voltages and of the frames; the analysis gets all of them."""
    drives = EXPERIMENTS["delay"].plan(rig, "right")
    records = on_simulation(rig, "right", "delay", drives, 1, lambda _: None)
    middle = len(records) // 2
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path, part in zip(paths, (records[:middle], records[middle:]), strict=True):
        with LogWriter(path, rig.logging) as log:
            log.write(run_info(rig, "", 0.0, designs={}), WALL_S)
            newest_s = 0.0  # a recorder's log times never go back
            for record in part:
                newest_s = max(newest_s, record.time_s)
                log.write(record, WALL_S + newest_s)

    found = EXPERIMENTS["delay"].from_logs(rig, "right", paths)

    whole = EXPERIMENTS["delay"].from_records(rig, "right", records)
    assert found.fragment() == whole.fragment()


def experimented(rig, logs):
    """What is found by a rig that names these logs, two of them while the experiment goes on.

    Its first message is from before the experiment, and comes late.
    """
    first, second, third = logs
    moments = [
        (99.9, "VERNIER", first),
        (100.1, "EXPERIMENT", first),
        (101.0, "EXPERIMENT", second),
        (109.0, "COARSE", second),
        (109.1, "COARSE", third),
    ]

    clock = SimpleNamespace(now_s=0.0, monotonic=lambda: clock.now_s)

    class Rigged:
        def send(self, _command):
            return Reply(accepted=True, time_s=100.0)

        def receive(self, _timeout_s):
            time_s, mode, log = moments.pop(0) if len(moments) > 1 else moments[0]
            clock.now_s += 1.1 if mode == "VERNIER" else 0.1
            loop = SimpleNamespace(name="right", mode=mode, last_change=None)
            recorder = SimpleNamespace(path=str(log))
            return SimpleNamespace(time_s=time_s, loops=[loop], recorder=recorder)

    drive = Drive(channel="fsm_az", shape="sine", amplitude=1.0, frequency_hz=1.0, duration_s=9.0)
    with patch.object(runs, "time", clock):
        return runs.on_rig(Rigged(), rig, "right", "delay", [drive], lambda _: None)


@pytest.fixture
def logs(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "_FLUSH_SLACK_S", 0.0)
    paths = [tmp_path / f"{rig.name}_20261121T00000{number}Z.mcap" for number in range(3)]
    for path in paths:
        path.touch()
    return paths


def test_the_logs_of_an_experiment_are_those_that_were_written_meanwhile(rig, logs):
    assert experimented(rig, logs) == logs


@pytest.mark.long
def test_what_the_supervisor_names_as_its_log_is_read_only_if_it_is_a_log_of_ours(
    rig, logs, monkeypatch
):
    named = logs[1]
    named.unlink()
    os.mkfifo(named)
    with pytest.raises(IdentifyError, match="not a regular file"):
        experimented(rig, logs)
    named.unlink()
    with pytest.raises(IdentifyError, match="No such file"):
        experimented(rig, logs)
    for other in ("/etc/passwd", "/dev/zero", str(named.with_name("other_20261121T000001Z.mcap"))):
        with pytest.raises(IdentifyError, match=f"{other}, .* not that of a log of rig {rig.name}"):
            experimented(rig, [logs[0], other, logs[2]])
    named.touch()
    monkeypatch.setattr(os, "getuid", lambda: 4242)
    with pytest.raises(IdentifyError, match="it belongs to user"):
        experimented(rig, logs)


def test_ctrl_c_ends_the_experiment_on_the_rig(rig):
    given = []

    class Rigged:
        def send(self, command):
            given.append(command)
            return Reply(accepted=True)

        def receive(self, _timeout_s):
            raise KeyboardInterrupt

    drive = Drive(channel="fsm_az", shape="sine", amplitude=1.0, frequency_hz=1.0, duration_s=9.0)
    with pytest.raises(KeyboardInterrupt):
        runs.on_rig(Rigged(), rig, "right", "delay", [drive], lambda _: None)
    assert [type(command) for command in given] == [Experiment, Release]
    assert given[1].loop == "right"


@pytest.fixture
def begun(monkeypatch):
    """An experiment that ends as soon as it is begun."""

    def end(*_):
        msg = "begun"
        raise IdentifyError(msg)

    monkeypatch.setattr(commands, "on_simulation", end)


def plots_of(monkeypatch):
    """An experiment with a plot but no values, as a response with three modes."""

    class Finding:
        def draw(self):
            return new_figure()

        def lines(self):
            return []

        def fragment(self):
            msg = "no values"
            raise IdentifyError(msg)

    monkeypatch.setattr(commands, "_finding", lambda *_: Finding())


@pytest.mark.parametrize("words", [[], ["--plot", "other.svg"]])
def test_a_plot_of_something_else_is_not_replaced(identify, begun, tmp_path, words):
    for name in ("camera.png", "other.svg"):
        (tmp_path / name).write_text("mine")

    status, err = identify("delay", "--simulate", "--out", "camera.toml", *words)

    assert status == 2
    assert f"{words[-1] if words else 'camera.png'}: exists already" in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("plot", ["a.png", "a.svg"])
def test_an_experiment_replaces_its_own_plot_and_no_measured_one(
    identify, monkeypatch, tmp_path, plot
):
    plots_of(monkeypatch)
    by = ("delay", "--simulate", "--plot", plot)
    assert [identify(*by)[0], identify(*by)[0]] == [1, 1]
    (tmp_path / plot).write_bytes((tmp_path / plot).read_bytes().replace(b" --simulate`", b"`"))

    status, err = identify(*by)

    assert status == 2
    assert "exists already, and was not written by fitctl identify delay --simulate" in err


@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_a_name_that_is_too_long_for_a_file_is_one_line(identify, option):
    status, err = identify("delay", "--simulate", option, f"{'a' * 300}.png")

    assert status == 2
    assert "nothing can be written there" in err
    assert len(err.splitlines()) == 1


def test_so_is_a_folder_that_one_may_not_enter(identify, monkeypatch):
    stat = Path.stat

    def refused(path, **options):
        if path.parent.name == "closed":
            raise PermissionError(13, "Permission denied")
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refused)
    status, err = identify("delay", "--simulate", "--out", "closed/a.toml")

    assert status == 2
    assert "closed/a.toml: nothing can be written there" in err
