"""`fitctl log` as a stranger meets it."""

import csv
import json
import os
import re
import sys

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from samples.forged_logs import forged, with_topic_of_another_program
from samples.log_samples import (
    RUN_INFO,
    SETTINGS,
    SMALL_CHUNKS,
    contents,
    files_end_at,
    frame,
    one_of_each,
    tick,
    write_log,
)

from fitctl.cli import main
from fitctl.commands.analyse.log import app
from fitctl.logging.reading import log_info
from fitctl.logging.records import AnyRecord
from fitctl.logging.writer import LogWriter

RECORDS = [RUN_INFO, *one_of_each(), *(r for n in range(2, 12) for r in (tick(n), frame(n)))]


@pytest.fixture
def whole(tmp_path):
    return write_log(tmp_path / "a.mcap", RECORDS, SMALL_CHUNKS)


@pytest.fixture
def broken(whole):
    path = whole.with_name("broken.mcap")
    path.write_bytes(whole.read_bytes()[:-2000])
    return path


@pytest.fixture
def log(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["log", *map(str, arguments)])
        printed = capsys.readouterr()
        return end.value.code or 0, printed.out.strip(), printed.err.strip()

    return run


@pytest.mark.parametrize(
    "command", [c.name or c.callback.__name__ for c in app.registered_commands]
)
def test_every_command_has_a_help_text(log, command):
    status, text, _ = log(command, "--help")
    assert status == 0
    assert len(text.splitlines()) > 5


def test_info_says_what_is_in_a_log_and_how_it_is(log, whole, broken):
    status, text, _ = log("info", whole)
    assert status == 0
    first, span, *topics = text.splitlines()
    assert first == f"{whole}: finished"
    assert span == "from 2026-11-18 11:08:21 UTC, 27.0 s"
    assert dict(line.split() for line in topics) == {
        topic: str(count) for topic, count in log_info(whole).counts.items()
    }
    assert log("info", broken)[1].startswith(f"{broken}: cut off; `fitctl log recover` mends it\n")
    with LogWriter(whole.with_name("now.mcap"), SETTINGS) as writer:
        assert log("info", writer.path)[1] == f"{writer.path}: being recorded\nwithout any record"


def test_info_as_json_has_the_rig_file_too(log, whole):
    document = json.loads(log("info", whole, "--json")[1])
    assert document["counts"] == log_info(whole).counts
    assert document["metadata"]["rig"]["json"] == RUN_INFO.rig_json
    assert (document["finished"], document["recording"], document["kept"]) == (True, False, False)


def test_verify_checks_the_others_where_one_is_no_log(log, whole, tmp_path):
    empty = tmp_path / "empty.mcap"
    empty.touch()

    status, text, err = log("verify", empty, whole)
    assert status == 2
    assert f"{whole}: whole" in text
    assert f"{empty}: is not an MCAP log" in err

    status, text, _ = log("verify", empty, whole, "--json")
    assert status == 2
    assert [each["whole"] for each in json.loads(text)] == [False, True]


def test_verify_tells_by_its_status_whether_all_are_whole(log, whole, broken):
    status, text, _ = log("verify", whole)
    assert (status, text) == (
        0,
        f"{whole}: whole; 28 records, 3 lost on the way, 0 frames missing",
    )
    status, text, _ = log("verify", whole, broken)
    assert status == 1
    assert f"{broken}: not whole" in text
    assert "is cut off" in text


def test_recover_says_how_many_records_were_saved_and_overwrites_nothing(log, whole, broken):
    before = broken.read_bytes()
    status, text, _ = log("recover", broken)
    target = broken.with_name("broken_recovered.mcap")
    saved = int(re.search(r"(\d+) records saved", text)[1])
    assert status == 0
    assert contents(target) == contents(whole)[:saved]
    assert saved == len(contents(broken)) > 20
    assert broken.read_bytes() == before
    assert log("verify", target)[0] == 0

    status, text, error = log("recover", broken)
    assert (status, text) == (2, "")
    assert error == (f"{target}: exists already; give another name with --out, or pass --overwrite")
    assert log("recover", broken, "--overwrite")[0] == 0


def test_recover_names_what_it_cannot_mend(log, whole, tmp_path):
    """Recover cannot know the right time of a record whose own time is wrong."""
    tick = "/fit/right/tick"
    wrong = forged(whole, tmp_path / "wrong.mcap", lambda one: 0 if one.topic == tick else None)

    status, text, _ = log("recover", wrong)
    assert status == 1
    assert "cannot be mended: record" in text
    assert "its own time is more than a day outside the log's" in text

    status, text, _ = log("recover", wrong, "--overwrite", "--json")
    assert status == 1
    assert len(json.loads(text)["problems"]) == 1


def test_recover_leaves_a_whole_log_alone(log, whole):
    assert log("recover", whole) == (0, f"{whole}: is not damaged; there is nothing to repair", "")
    assert list(whole.parent.iterdir()) == [whole]


@pytest.mark.parametrize("span", [("3", "7.5"), ("2026-11-18T11:08:24.5", "2026-11-18T11:08:29Z")])
def test_cut_takes_seconds_or_utc_and_topics_by_pattern(log, whole, span):
    target = whole.with_name("part.mcap")
    options = ("--from", span[0], "--to", span[1], "--out", target, "--overwrite")
    assert log("cut", whole, *options) == (0, f"{target}: 5 of 28 records", "")
    assert contents(target) == contents(whole)[3:8]
    log("cut", whole, *options, "--topic", "/fit/right/*", "--topic", "/fit/events")
    assert contents(target) == [
        e for e in contents(whole)[3:8] if "right" in e[0] or "events" in e[0]
    ]


def test_cut_leaves_no_late_record_out_unasked(log, tmp_path):
    late = write_log(tmp_path / "late.mcap", [tick(1)], start_s=9.3e9)  # after 2**63 ns
    status, text, _ = log("cut", late)
    assert (status, "1 of 1 records" in text) == (0, True)


def test_merge_joins_what_cut_took_apart(log, whole):
    head, tail, target = (whole.with_name(f"{name}.mcap") for name in ("head", "tail", "all"))
    log("cut", whole, "--to", "9", "--out", head)
    log("cut", whole, "--from", "9", "--out", tail)
    assert log("merge", tail, head, "--out", target) == (0, f"{target}: 28 records of 2 logs", "")
    assert contents(target) == contents(whole)


def test_csv_reads_back_as_it_was_recorded(log, whole):
    status, text, _ = log("export", whole, "--format", "csv", "--topic", "/fit/right/tick")
    file = whole.with_name("a_csv") / "fit.right.tick.csv"
    assert (status, text) == (0, f"{file}: 11 rows")
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["time_s"]) for row in rows] == [100.0 + 0.02 * n for n in range(1, 12)]
    assert rows[0]["mode"] == "VERNIER"
    assert rows[0]["star_az_px"] == "nan"
    assert list(rows[0])[:3] == ["log_time_ns", "publish_time_ns", "sequence"]


def test_numpy_and_parquet_have_frames_and_the_same_columns(log, whole):
    parquet = pytest.importorskip("pyarrow.parquet")
    narrow = whole.with_name("narrow.mcap")  # its frames are all of one size
    log("cut", whole, "--from", "8", "--out", narrow)
    assert log("export", narrow, "--format", "npz")[0] == 0
    assert log("export", narrow, "--format", "parquet")[0] == 0
    arrays = np.load(whole.with_name("narrow_npz") / "fit.camera.frame.npz")
    assert arrays["pixels_dn"].shape == (10, 40, 40)
    assert arrays["pixels_dn"][3].tobytes() == frame(5).data
    table = parquet.read_table(whole.with_name("narrow_parquet") / "fit.camera.frame.parquet")
    assert set(table.column_names) == set(arrays)
    assert table["pixels_dn"][3].as_py() == frame(5).data
    ticks = np.load(whole.with_name("narrow_npz") / "fit.right.tick.npz")
    table = parquet.read_table(whole.with_name("narrow_parquet") / "fit.right.tick.parquet")
    for name in ticks:
        np.testing.assert_array_equal(ticks[name], np.array(table[name].to_pylist()))


def test_events_are_exported_with_their_level_as_a_word(log, whole):
    log("export", whole, "--format", "npz", "--topic", "/fit/events")
    events = np.load(whole.with_name("a_npz") / "fit.events.npz")
    assert [str(events[name][0]) for name in ("level", "source", "message")] == [
        "WARNING",
        "loop right",
        "star lost",
    ]


# Real numbers that are what they are, without a unit; the one of a quantity is in the quantity's own name.
DIMENSIONLESS = {"fsm_range_fraction", "search_progress", "value", "visibility"}
UNITS = ("_s", "_px", "_rad", "_v", "_arcsec", "_dn", "_m", "_hz")


@pytest.mark.parametrize("record", AnyRecord.__args__, ids=lambda record: record.__name__)
def test_every_real_number_has_its_unit_in_its_name(record):
    reals = [name for name, kind in record.__annotations__.items() if kind == "float"]
    assert [name for name in reals if not name.endswith(UNITS) and name not in DIMENSIONLESS] == []


def test_nothing_exported_is_overwritten(log, whole):
    log("export", whole, "--format", "csv", "--topic", "/fit/events")
    status, _, error = log("export", whole, "--format", "csv", "--topic", "/fit/events")
    assert status == 2
    assert "fit.events.csv: exists already; give another folder with --out" in error


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_an_export_that_fails_leaves_no_part_of_it(log, whole, kind):
    pytest.importorskip("pyarrow.parquet")
    out = whole.with_name("tables")
    out.mkdir()
    (out / f"fit.events.{kind}").write_text("somebody's own")  # the log's other topics come first
    status, _, error = log("export", whole, "--format", kind, "--out", out)
    assert (status, "exists already" in error) == (2, True)
    assert [path.name for path in out.iterdir()] == [f"fit.events.{kind}"]
    assert (out / f"fit.events.{kind}").read_text() == "somebody's own"


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_an_export_onto_a_full_disk_leaves_no_part_of_it(log, whole, kind):
    pytest.importorskip("pyarrow.parquet")
    narrow, out = whole.with_name("narrow.mcap"), whole.with_name("tables")
    log("cut", whole, "--from", "8", "--out", narrow)
    with files_end_at(1000):
        status, _, error = log("export", narrow, "--format", kind, "--out", out)
    assert (status, f"{out}: cannot be written: " in error) == (2, True), error
    assert not out.exists()


def test_parquet_without_pyarrow_says_what_to_do(log, whole, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    status, _, error = log("export", whole, "--format", "parquet")
    assert status == 2
    assert "pip install 'fitctl[parquet]'" in error


def test_keep_marks_and_unmarks(log, whole):
    assert log("keep", whole) == (0, f"{whole}: kept", "")
    assert log("info", whole)[1].startswith(f"{whole}: finished; kept\n")
    assert log("keep", whole, "--undo") == (0, f"{whole}: no longer kept", "")
    assert log("info", whole)[1].startswith(f"{whole}: finished\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["info", "none.mcap"], "none.mcap: cannot be opened: No such file"),
        (["info", "."], ".: cannot be opened: not a regular file"),
        (["verify", "TEXT"], "is not an MCAP log"),
        (["summary", "none.mcap"], "none.mcap: cannot be read: No such file"),
        (["summary", ""], ".: cannot be opened: not a regular file"),
        (["summary", "TEXT"], "is not an MCAP log"),
        (["recover", "TEXT"], "is not an MCAP log"),
        (["recover", "."], ".: cannot be opened: not a regular file"),
        (["cut", "LOG", "--out", ".", "--overwrite"], ".: cannot be opened: not a regular file"),
        (["cut", "LOG", "--from", "noon"], "--from noon: expected seconds, or UTC such as"),
        (["cut", "LOG", "--from", "nan"], "--from nan: is no time"),
        (["cut", "LOG", "--to", "1e300"], "--to 1e300: is no time"),
        (["cut", "LOG", "--from", "5", "--to", "5"], "--to 5 is not after --from 5"),
        (["cut", "LOG", "--from", "9999-12-31T23:59:59"], "ends before --from 9999-12-31T23:59:59"),
        (["cut", "LOG", "--from", "5000"], "has no record of these topics in that time"),
        (["cut", "LOG", "--topic", "/fit/left/*"], "no such topic. Available: /fit/camera/frame"),
        (
            ["cut", "LOG", "--out", "no/such/folder/x.mcap"],
            "x.mcap: cannot be written: No such file",
        ),
        (["merge", "LOG"], "--out"),
        (["merge", "LOG", "TEXT", "--out", "new.mcap"], "is not an MCAP log"),
        (["export", "LOG", "--format", "xlsx"], "xlsx"),
        (["export", ".", "--format", "csv"], ".: cannot be opened: not a regular file"),
        (
            ["export", "LOG", "--format", "csv", "--topic", "/fit/camera/frame"],
            "need npz or parquet",
        ),
        (["export", "LOG", "--format", "npz"], "frames of several sizes"),
        (["export", "LOG", "--format", "csv", "--out", "TEXT"], "cannot be written"),
        (["keep", "none.mcap"], "none.mcap: no such log"),
        (["mend", "LOG"], "mend"),
    ],
)
def test_bad_input_gets_one_clear_line_and_status_2(
    log, whole, tmp_path, monkeypatch, arguments, said
):
    text = tmp_path / "text.mcap"
    text.write_text("TIME,AZ,EL\n")
    monkeypatch.chdir(tmp_path)
    named = {"LOG": whole, "TEXT": text}
    status, _, error = log(*(named.get(word, word) for word in arguments))
    assert status == 2
    assert said in error
    assert len(error.splitlines()) == 1
    assert error.count(said) == 1
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == ["a.mcap", "text.mcap"]


@pytest.mark.parametrize("command", [("recover",), ("cut",), ("merge", "whole.mcap")])
def test_a_log_is_never_overwritten_by_what_is_made_from_it(log, broken, monkeypatch, command):
    monkeypatch.chdir(broken.parent)
    write_log(broken.with_name("whole.mcap"), RECORDS)
    broken.with_name("other_name.mcap").symlink_to(broken)
    content = broken.read_bytes()

    status, text, problem = log(*command, "broken.mcap", "--out", "other_name.mcap", "--overwrite")

    assert (status, text) == (2, "")
    assert problem == (
        "other_name.mcap: is the log itself, which must not change; give another name with --out"
    )
    assert broken.read_bytes() == content
    assert broken.with_name("other_name.mcap").is_symlink()


def test_a_log_of_another_program_is_not_called_damaged(log, tmp_path):
    path = with_topic_of_another_program(tmp_path / "b.mcap")

    status, text, problem = log("verify", path)

    assert (status, text) == (2, "")
    assert problem == (
        f"{path}: has topics in another format than fitctl's: /odo is in json; expected protobuf"
    )


def test_a_log_whose_name_is_not_utf_8_is_read_and_recovered(log, whole, broken):
    odd, torn = (whole.with_name(os.fsdecode(name)) for name in (b"h\xff.mcap", b"c\xff.mcap"))
    whole.rename(odd)
    broken.rename(torn)

    for command in ("info", "verify", "summary"):
        _, text, problem = log(command, odd, "--json")
        found = json.loads(text)
        path = (found[0] if command == "verify" else found)["path"]
        assert (path, problem) == (f"{odd.parent}/h\\udcff.mcap", "")

    status, text, _ = log("recover", torn)
    assert status == 0
    assert text.startswith(f"{torn.parent}/c\\udcff_recovered.mcap: ")
    assert log("verify", torn.with_name(os.fsdecode(b"c\xff_recovered.mcap")))[0] == 0


def test_damage_without_words_has_words(log, whole, monkeypatch):
    def end(*_, **__):
        raise EndOfFile

    monkeypatch.setattr("fitctl.logging.verifying.StreamReader", end)
    monkeypatch.setattr("fitctl.logging.reading.SeekingReader", end)

    for command in ("verify", "info"):
        _, text, problem = log(command, whole)
        assert "is damaged: its records do not fit together (EndOfFile); `fitctl" in text + problem


def test_a_log_without_records_is_called_that(log, tmp_path, capsys):
    path = write_log(tmp_path / "zero.mcap", [RUN_INFO])

    assert log("cut", path) == (
        2,
        "",
        f"cut: {path} has no record, so there is nothing to cut; name another log",
    )
    with pytest.raises(SystemExit) as end:
        main(["plot", str(path), "error_az_px"])
    assert end.value.code == 2
    assert "zero.mcap has no record, so there is nothing to plot" in capsys.readouterr().err
