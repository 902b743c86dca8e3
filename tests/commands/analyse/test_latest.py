"""`fitctl log list`, and `--latest` in place of a LOG: the newest run of the rig that is addressed."""

import json
import os

import msgspec
import pytest
from samples.forged_logs import forged
from samples.log_samples import RUN_INFO, WALL_S, one_of_each, tick, write_log

from fitctl.cli import main
from fitctl.commands.design import identify
from fitctl.config import default_rig_path, load_rig
from fitctl.identify.errors import IdentifyError
from fitctl.logging.copying import merge, recover
from fitctl.logging.listing import logs_in, newest_run
from fitctl.report.run import find_run

SHIPPED = load_rig(default_rig_path())
RIG = SHIPPED.name
DAY_S = 86400.0


def run_of(name, later_s):
    """The first record of a run of a rig that began later than the sample's."""
    wall_s = RUN_INFO.wall_minus_monotonic_s + later_s
    return msgspec.structs.replace(RUN_INFO, rig_name=name, wall_minus_monotonic_s=wall_s)


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Two runs of the shipped rig and a newer one of another; names do not sort as times do."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FITCTL_RIG", str(default_rig_path()))
    folder = tmp_path / "logs"
    folder.mkdir()
    for file, name, later_s in (
        ("z.mcap", RIG, 0.0),
        ("b.mcap", RIG, DAY_S),
        ("a.mcap", "another", 2 * DAY_S),
    ):
        path = folder / file
        info = run_of(name, later_s)
        write_log(path, [info, *one_of_each(), tick(2)], start_s=WALL_S + later_s)
    return folder


@pytest.fixture
def fitctl(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main([str(one) for one in arguments])
        printed = capsys.readouterr()
        return end.value.code or 0, printed.out.strip(), printed.err.strip()

    return run


def test_list_has_every_log_of_the_folder_oldest_first(fitctl, logs):
    status, text, _ = fitctl("log", "list")

    assert status == 0
    assert [line.split()[0] for line in text.splitlines()] == [
        "logs/z.mcap",
        "logs/b.mcap",
        "logs/a.mcap",
    ]
    listed = json.loads(fitctl("log", "list", "--json")[1])
    assert [one["rig"] for one in listed] == [RIG, RIG, "another"]
    assert all(one["finished"] and not one["kept"] for one in listed)


def test_a_folder_of_logs_in_somebody_s_home_is_found(fitctl, logs, monkeypatch):
    monkeypatch.setenv("HOME", str(logs.parent))
    at_home = ("--set", "logging.folder=~/logs")

    assert "z.mcap" in fitctl("log", "list", *at_home)[1]
    assert fitctl("log", "list", "--set", "logging.folder=~no-such-user/logs")[0] == 2


def test_list_names_a_file_that_cannot_be_read(fitctl, logs):
    (logs / "torn.mcap").write_bytes(b"nothing of MCAP")

    status, text, problems = fitctl("log", "list")

    assert status == 1
    assert len(text.splitlines()) == 3
    assert "torn.mcap" in problems


@pytest.mark.parametrize("json_", [[], ["--json"]])
def test_list_leaves_out_a_log_that_is_deleted_meanwhile(fitctl, logs, monkeypatch, json_):
    def read_and_deleted(folder):
        found = logs_in(folder)
        (logs / "z.mcap").unlink()
        return found

    monkeypatch.setattr("fitctl.commands.analyse.log.logs_in", read_and_deleted)

    status, text, problems = fitctl("log", "list", *json_)

    assert (status, problems) == (0, "")
    assert ["b.mcap" in text, "a.mcap" in text, "z.mcap" in text] == [True, True, False]


@pytest.mark.parametrize("command", [("log", "info"), ("log", "verify")])
def test_latest_is_the_newest_log_of_the_rig_by_time_not_by_name(fitctl, logs, command):
    _, text, _ = fitctl(*command, "--latest")

    assert text.startswith("logs/b.mcap: ")


def test_copies_are_the_newest_run_only_where_none_of_its_own_files_is_left(fitctl, logs):
    for copy in (("cut",), ("merge", "--out", "logs/merged.mcap")):
        assert fitctl("log", *copy, "logs/b.mcap")[0] == 0

    assert newest_run(logs, RIG) == [logs / "b.mcap"]
    assert [one.path for one in find_run([logs], SHIPPED).logs] == [logs / "a.mcap"]
    (logs / "a.mcap").unlink()
    assert [one.path for one in find_run([logs], SHIPPED).logs] == [logs / "b.mcap"]

    (logs / "b.mcap").unlink()
    (logs / "merged.mcap").unlink()
    assert newest_run(logs, RIG) == [logs / "b_cut.mcap"]
    assert [one.path for one in find_run([logs], SHIPPED).logs] == [logs / "b_cut.mcap"]


def test_a_plot_without_from_begins_with_what_waited_for_the_recorder(fitctl, logs, tmp_path):
    waited = [tick(1, time_s=98.0), tick(2, time_s=100.0)]
    late = write_log(tmp_path / "late.mcap", [RUN_INFO, *waited])

    assert fitctl("plot", late, "error_az_px", "--to", "-1.0")[0] == 0
    assert fitctl("plot", late, "error_az_px", "--from", "0", "--to", "-1.0")[0] == 2


def test_a_plot_whose_end_is_before_its_beginning_says_so(fitctl, logs):
    status, _, problem = fitctl("plot", "logs/b.mcap", "record*", "--from", "20", "--to", "10")

    assert status == 2
    assert problem.startswith("plot: --to 10 is not after --from 20; choose a later --to")


def test_latest_goes_before_the_topics_of_a_plot(fitctl, logs):
    by_name = fitctl("plot", "logs/b.mcap", "record*")

    assert fitctl("plot", "--latest", "record*") == by_name
    assert by_name[0] == 0
    assert "after b.mcap" in by_name[1]


@pytest.mark.parametrize(
    "arguments",
    [
        ("log", "info"),
        ("log", "verify"),
        ("log", "cut"),
        ("log", "recover"),
        ("log", "keep"),
        ("log", "export", "--format", "csv"),
        ("log", "summary"),
        ("replay",),
        ("report",),
        ("design", "learn"),
    ],
)
def test_without_log_and_without_latest_the_error_names_both(fitctl, logs, arguments):
    status, text, problem = fitctl(*arguments)

    assert (status, text) == (2, "")
    assert "LOG" in problem
    assert "--latest" in problem


def test_a_log_and_latest_are_too_many(fitctl, logs):
    status, _, problem = fitctl("log", "info", "logs/z.mcap", "--latest")

    assert status == 2
    assert "leave out --latest, or logs/z.mcap" in problem


def test_identify_and_the_console_read_the_newest_log_too(fitctl, logs, monkeypatch):
    shown = []
    monkeypatch.setenv("TEXTUAL_DRIVER", "a browser's")
    monkeypatch.setattr(
        "fitctl.commands.operate.console._show_log", lambda log, *_, web: shown.append(log)
    )

    status, _, _ = fitctl("console", "--latest")
    _, _, problem = fitctl("identify", "airpath", "--latest")

    assert (status, [path.name for path in shown]) == (0, ["b.mcap"])
    assert "the stages never stood still" in problem  # the sample was read, and has no frames


def test_latest_of_a_rig_without_logs_names_folder_and_rig(fitctl, logs):
    for path in logs.glob("[bz].mcap"):
        path.unlink()

    status, _, problem = fitctl("log", "info", "--latest")

    assert status == 2
    assert f"logs has no log of rig {RIG}" in problem


def test_info_of_several_logs_as_json_is_an_object_a_line(fitctl, logs):
    _, text, _ = fitctl("log", "info", *sorted(logs.glob("*.mcap")), "--json")

    documents = [json.loads(line) for line in text.splitlines()]
    assert [one["path"][-6:] for one in documents] == ["a.mcap", "b.mcap", "z.mcap"]


def test_checks_and_faults_have_json_for_programs(fitctl, logs):
    checked = json.loads(fitctl("check", default_rig_path(), "--json")[1])
    kinds = json.loads(fitctl("fault", "kinds", "--json")[1])
    whole = json.loads(fitctl("log", "verify", "--latest", "--json")[1])
    sequence = json.loads(fitctl("sequence", "check", "dither", "--json")[1])

    assert checked["rig"] == RIG
    assert kinds["camera"]["freeze"]["text"]
    assert whole[0]["whole"] is True
    assert sequence["steps"] > 1


def test_check_refuses_two_rig_files(fitctl, logs):
    status, _, problem = fitctl("check", "one.toml", "--rig", "two.toml")

    assert status == 2
    assert "expected one rig file" in problem


def test_python_finds_the_newest_run_of_a_rig_by_its_records_not_by_the_names_of_files(logs):
    assert newest_run(logs, RIG) == [logs / "b.mcap"]
    assert newest_run(logs, "another") == [logs / "a.mcap"]
    assert newest_run(logs, "none") == []


@pytest.mark.long
def test_a_report_says_how_many_records_it_leaves_out(fitctl, logs):
    forged(logs / "a.mcap", logs / "c.mcap", lambda record: {2: 2**62}.get(record.sequence))

    _, _, problem = fitctl("report", "logs/c.mcap", "--rig", default_rig_path())

    assert problem == (
        "c: 1 records are left out: their own time is more than a day outside the run's; see fitctl log verify"
    )


def damaged(path, written_s):
    """A log of which a byte was changed in its index, last written then."""
    content = bytearray(path.read_bytes())
    content[-60] ^= 0xFF
    path.write_bytes(content)
    os.utime(path, (written_s, written_s))


def test_latest_names_an_older_log_that_cannot_be_read_and_goes_on(fitctl, logs):
    damaged(logs / "z.mcap", written_s=1.0)

    status, text, problems = fitctl("log", "info", "--latest")

    assert status == 0
    assert text.startswith("logs/b.mcap: ")
    (line,) = problems.splitlines()
    assert line.startswith("logs/z.mcap: ")


@pytest.mark.parametrize("command", [("log", "verify", "--latest"), ("report", "logs")])
def test_a_newer_log_that_cannot_be_read_is_not_passed_over_for_an_older_night(
    fitctl, logs, command
):
    (logs / "a.mcap").unlink()
    os.utime(logs / "z.mcap", (1.0, 1.0))
    damaged(logs / "b.mcap", written_s=2.0)

    status, text, problem = fitctl(*command)

    assert (status, text) == (2, "")
    assert problem.count("\n") == 0
    assert problem.startswith("logs/b.mcap: ")
    assert "It was written after logs/z.mcap, so the newest run may be in it; name a LOG" in problem


def test_what_was_recovered_counts_in_place_of_the_damaged_file(fitctl, logs):
    (logs / "a.mcap").unlink()
    os.utime(logs / "z.mcap", (1.0, 1.0))
    damaged(logs / "b.mcap", written_s=2.0)
    assert fitctl("log", "recover", "logs/b.mcap")[0] == 0
    assert fitctl("log", "cut", "logs/b_recovered.mcap")[0] == 0

    status, text, problems = fitctl("log", "info", "--latest")

    assert status == 0
    assert text.startswith("logs/b_recovered.mcap: ")
    (line,) = problems.splitlines()
    assert line.startswith("logs/b.mcap: ")


def test_what_was_recovered_of_a_name_that_is_not_utf_8_counts_too(fitctl, logs):
    (logs / "a.mcap").unlink()
    os.utime(logs / "z.mcap", (1.0, 1.0))
    odd = (logs / "b.mcap").rename(logs / os.fsdecode(b"b\xff.mcap"))
    damaged(odd, written_s=2.0)
    recover(odd, logs / "saved.mcap")

    assert newest_run(logs, RIG) == [logs / "saved.mcap"]


def test_what_was_recovered_is_left_out_beside_the_file_itself(fitctl, logs):
    assert recover(logs / "b.mcap", logs / "saved.mcap").records > 0

    assert newest_run(logs, RIG) == [logs / "b.mcap"]


@pytest.mark.long
def test_reports_and_designs_of_a_folder_name_what_cannot_be_read_in_it(fitctl, logs):
    (logs / "torn.mcap").write_bytes(b"nothing of MCAP")

    for command in (("report", "logs"), ("design", "learn", "logs")):
        _, _, problems = fitctl(*command, "--rig", default_rig_path())
        assert problems.startswith("logs/torn.mcap: is not an MCAP log")


@pytest.mark.parametrize(
    "command",
    [
        *(("log", one) for one in ("info", "verify", "summary", "recover", "cut", "keep")),
        ("log", "export", "--format", "csv"),
        ("plot",),
    ],
)
def test_a_rig_beside_a_log_is_refused_where_it_would_say_nothing(fitctl, logs, command):
    status, text, problem = fitctl(
        *command, "logs/b.mcap", *["number"] * (command == ("plot",)), "--rig", default_rig_path()
    )

    assert (status, text) == (2, "")
    assert (
        problem == f"{' '.join(command[:2])}: --rig is for --latest; leave it out, or logs/b.mcap"
    )


@pytest.mark.parametrize(("named", "of"), [([], "another"), (["--rig", default_rig_path()], RIG)])
def test_identify_uses_the_rig_of_the_log_unless_one_is_named(fitctl, logs, monkeypatch, named, of):
    monkeypatch.delenv("FITCTL_RIG")
    used = []

    def finding(rig, *_):
        used.append(rig.name)
        msg = "nothing"
        raise IdentifyError(msg)

    monkeypatch.setattr(identify, "_finding", finding)
    another = load_rig(default_rig_path(), ["name=another"]).model_dump_json()
    info = msgspec.structs.replace(RUN_INFO, rig_name="another", rig_json=another)
    write_log(logs / "own.mcap", [info, *one_of_each()])

    status, _, problem = fitctl("identify", "spot", "--log", "logs/own.mcap", *named)

    assert (status, used) == (2, [of])
    assert ("rig another: in logs/own.mcap" in problem) == (not named)


def test_a_seed_that_nothing_uses_is_refused(fitctl, logs):
    status, _, problem = fitctl("identify", "spot", "--log", "logs/b.mcap", "--seed", "7")
    assert status == 2
    assert problem == "identify: --seed is for --simulate and --mocks; leave it out"


def test_a_plot_that_begins_after_the_end_names_no_end(fitctl, logs):
    _, _, problem = fitctl("plot", "logs/b.mcap", "record*", "--from", "1e20")
    assert problem.startswith("plot: the last record is not after --from 1e20")


def test_identify_refuses_a_log_of_several_runs(fitctl, logs):
    merge([logs / "b.mcap", logs / "z.mcap"], logs / "both.mcap")

    for what in ("spot", "airpath", "delay"):
        status, _, problem = fitctl("identify", what, "--log", "logs/both.mcap")
        assert status == 2
        assert problem.startswith("logs/both.mcap: holds 2 runs")
