"""Files that follow each other, and what stays of them."""

import os
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from samples.log_samples import RUN_INFO, SETTINGS, WALL_S, contents, files_end_at, frame, tick

from fitctl.config import Logging
from fitctl.logging.copying import merge
from fitctl.logging.errors import LogError
from fitctl.logging.folder import in_use, is_kept, keep, new_log_path, prune
from fitctl.logging.listing import logs_in
from fitctl.logging.reading import log_info, tick_arrays
from fitctl.logging.rotation import RotatingLog
from fitctl.logging.verifying import verify
from fitctl.logging.writer import LogWriter

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
DAY_S = 86400
SMALL = SETTINGS.model_copy(update={"rotate_bytes": 65_536, "chunk_bytes": 4096})


def recorded(settings, folder, number, flush_every=5):
    """Ticks and frames through a rotating log that is flushed now and then; the log."""
    with RotatingLog(settings, "bench", folder) as log:
        log.write(RUN_INFO, WALL_S)
        for index in range(number):
            log.write(tick(index), WALL_S + index)
            log.write(frame(index), WALL_S + index)
            if index % flush_every == 0:
                log.flush()
                log.rotate_if_due()
    return log


def test_a_file_that_is_large_enough_is_followed_by_another_and_nothing_is_lost(tmp_path):
    log = recorded(SMALL, tmp_path, 100)
    files = sorted(tmp_path.glob("*.mcap"), key=lambda path: log_info(path).start_s)
    assert len(files) >= 4
    for path in files:
        assert verify(path).problems == ()
        assert log_info(path).metadata["rig"] == {"name": "bench", "json": '{"name": "bench"}'}
        assert path.stat().st_size < 65_536 + 40_000  # and one flush more
    assert [n for path in files for n in tick_arrays(path, "right")["number"]] == list(range(100))
    assert log.records == sum(sum(log_info(path).counts.values()) for path in files) + len(files)
    assert log.bytes_written == sum(path.stat().st_size for path in files)
    merge(files, tmp_path / "merged")
    assert list(tick_arrays(tmp_path / "merged", "right")["number"]) == list(range(100))


def test_a_file_that_is_old_enough_is_followed_by_another(tmp_path, monkeypatch):
    now_s = 1000.0
    monkeypatch.setattr("fitctl.logging.rotation.time.monotonic", lambda: now_s)
    with RotatingLog(SETTINGS, "bench", tmp_path) as log:
        first = log.path
        now_s += SETTINGS.rotate_s - 0.001
        log.rotate_if_due()
        assert log.path == first
        now_s += 0.001
        log.rotate_if_due()
        assert log.path != first
        assert log_info(first).finished


def test_a_log_is_in_use_while_it_is_recorded(tmp_path):
    with LogWriter(tmp_path / "a.mcap", SETTINGS) as writer:
        assert in_use(writer.path)
    assert not in_use(writer.path)
    assert not in_use(tmp_path / "none.mcap")


def aged(folder, name, age_days, size):
    path = folder / name
    path.write_bytes(b"x" * size)
    written_s = (NOW - timedelta(days=age_days)).timestamp()
    os.utime(path, (written_s, written_s))
    return path


def name_of(number, rig="bench"):
    return f"{rig}_20200101T0000{number:02d}Z.mcap"


def limits(retain_bytes, retain_days):
    return SETTINGS.model_copy(update={"retain_bytes": retain_bytes, "retain_days": retain_days})


@given(
    logs=st.lists(
        st.tuples(st.integers(0, 20), st.integers(1, 100), st.booleans(), st.booleans()),
        max_size=8,
    ),
    retain_bytes=st.integers(1, 400),
    retain_days=st.integers(1, 20),
)
@settings(max_examples=80, deadline=None)
@pytest.mark.long
def test_the_oldest_go_until_the_rest_fits_but_never_one_in_use_or_kept(
    tmp_path_factory, logs, retain_bytes, retain_days
):
    folder = tmp_path_factory.mktemp("retention")
    paths, safe, streams = [], set(), []
    age = 0
    for number, (days_before, size, kept, used) in enumerate(logs):
        age += min(days_before, retain_days)
        path = folder / name_of(number)
        if used:
            streams.append(LogWriter(path, SETTINGS))
            os.utime(path, ((NOW.timestamp() - age * DAY_S),) * 2)
        else:
            aged(folder, path.name, age, size)
        if kept:
            keep(path, kept=True)
        if kept or used:
            safe.add(path)
        paths.append((age, path, path.stat().st_size))
    try:
        deleted = [
            path
            for _ in logs  # age deletes one file a pass
            for path in prune(folder, "bench", limits(retain_bytes, retain_days), NOW).deleted
        ]
        left = [(age, path, size) for age, path, size in paths if path.exists()]
    finally:
        for stream in streams:
            stream.close()
    assert {path for _, path, _ in paths} - set(deleted) == {path for _, path, _ in left}
    assert safe.isdisjoint(deleted)
    free = [entry for entry in left if entry[1] not in safe]
    assert all(age <= retain_days for age, *_ in free)
    total = sum(size for *_, size in left)
    assert total <= retain_bytes or not free
    if deleted and free:  # the oldest went first
        ages = {path: age for age, path, _ in paths}
        assert min(ages[path] for path in deleted) >= max(age for age, *_ in free)
    if deleted:  # and none went without need
        age, size = next((age, size) for age, path, size in paths if path == deleted[-1])
        assert age > retain_days or total + size > retain_bytes


def test_only_what_a_recorder_of_this_rig_named_is_deleted(tmp_path):
    others = [
        aged(tmp_path, name, 400, 10)
        for name in (
            name_of(1, "other"),
            "bench_20200101T000001Z_recovered.mcap",
            "bench_best_night.mcap",
            "bench_20200101T000001Z.csv",
        )
    ]
    mine = [
        aged(tmp_path, name_of(1), 400, 10),
        aged(tmp_path, "bench_20200101T000001Z_2.mcap", 399, 10),
    ]
    assert prune(tmp_path, "bench", limits(1, 365), NOW).deleted == mine
    assert all(path.exists() for path in others)


def test_a_kept_log_stays_until_it_is_no_longer_kept(tmp_path):
    path = aged(tmp_path, name_of(1), 400, 10)
    keep(path, kept=True)
    assert is_kept(path)
    assert prune(tmp_path, "bench", SETTINGS, NOW).deleted == []
    keep(path, kept=False)
    assert prune(tmp_path, "bench", SETTINGS, NOW).deleted == [path]


def test_a_log_that_is_not_there_cannot_be_kept(tmp_path):
    with pytest.raises(LogError, match=r"a\.mcap: no such log"):
        keep(tmp_path / "a.mcap", kept=True)


def test_a_clock_that_is_400_days_ahead_costs_no_log(tmp_path):
    """Neither at once nor in the nights that are recorded with it."""
    logs = [aged(tmp_path, name_of(day), day, 10) for day in range(40)]
    ahead = NOW + timedelta(days=400)
    pruned = prune(tmp_path, "bench", SETTINGS, ahead)
    assert pruned.deleted == []
    assert pruned.refused == [
        f"{tmp_path}: no log was written for 400 days, or the computer's clock is wrong; "
        "logs from before are not deleted because of their age: check the clock"
    ]
    for night in range(1, 30):
        aged(tmp_path, f"bench_20210101T0000{night:02d}Z.mcap", -400 - night, 10)
        assert prune(tmp_path, "bench", SETTINGS, ahead + timedelta(days=night)).deleted == []
    assert prune(tmp_path, "bench", SETTINGS, NOW + timedelta(days=30)).deleted == []
    assert all(path.exists() for path in logs)


def test_a_log_s_name_is_evidence_of_its_time_too(tmp_path):
    """A copy may have lost its time of modification."""
    copied = aged(tmp_path, "bench_20261120T000001Z.mcap", 20_000, 10)
    assert prune(tmp_path, "bench", SETTINGS, NOW).deleted == []
    no_time = aged(tmp_path, "bench_99999999T999999Z.mcap", 400, 10)
    assert prune(tmp_path, "bench", SETTINGS, NOW).deleted == [no_time]
    assert copied.exists()


def test_after_a_long_pause_old_logs_go_once_new_ones_have_aged_too(tmp_path):
    old = [aged(tmp_path, name_of(number), 700 - number, 10) for number in (1, 2, 3)]
    for month in range(13):
        aged(tmp_path, f"bench_202001{month + 1:02d}T000000Z.mcap", 30 * month, 10)
    passes = [prune(tmp_path, "bench", limits(10**9, 300), NOW) for _ in range(3)]
    assert [one.deleted for one in passes] == [[path] for path in old]


def test_age_deletes_one_log_a_pass(tmp_path):
    logs = [aged(tmp_path, name_of(number), 369 - number, 10) for number in range(4)]
    aged(tmp_path, name_of(5), 180, 10)
    passes = [prune(tmp_path, "bench", SETTINGS, NOW).deleted for _ in range(5)]
    assert passes == [[path] for path in logs] + [[]]


def test_kept_logs_that_fill_the_room_are_said(tmp_path):
    kept = aged(tmp_path, name_of(1), 3, 100)
    keep(kept, kept=True)
    other = aged(tmp_path, name_of(2), 2, 10)
    assert prune(tmp_path, "bench", limits(110, 365), NOW).refused == []
    pruned = prune(tmp_path, "bench", limits(99, 365), NOW)
    assert pruned.deleted == [other]
    assert pruned.refused == [
        f"{tmp_path}: logs marked with `fitctl log keep` have 100 bytes, so all logs together "
        "exceed logging.retain_bytes = 99; move some, or unmark them"
    ]


def test_a_new_recording_clears_away_and_says_so_in_the_log(tmp_path):
    old = aged(tmp_path, name_of(1), 400, 10)
    with RotatingLog(SETTINGS, "bench", tmp_path) as log:
        assert not old.exists()
        assert log.pop_notes() == [("info", f"{old}: deleted, its time was over")]
        assert log.pop_notes() == []


def test_recording_goes_on_where_nothing_can_be_deleted(tmp_path, monkeypatch):
    old = aged(tmp_path, name_of(1), 400, 10)

    def refuse(path, **_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("fitctl.logging.folder.Path.unlink", refuse)
    with RotatingLog(SETTINGS, "bench", tmp_path) as log:
        ((severity, text),) = log.pop_notes()
        log.write(tick(1), WALL_S)
    assert severity == "warning"
    assert f"{old}: is due for deletion, but cannot be deleted" in text
    assert len(contents(log.path)) == 1


def test_one_log_that_cannot_be_deleted_keeps_none_of_the_others(tmp_path, monkeypatch):
    stuck, folder, gone = (tmp_path / name_of(day) for day in (1, 2, 3))
    aged(tmp_path, stuck.name, 403, 10)
    folder.mkdir()
    aged(tmp_path, gone.name, 401, 10)
    os.utime(folder, (0, 0))
    unlink = Path.unlink

    def refuse(path, **options):
        if path == stuck:
            raise PermissionError(1, "Operation not permitted")
        unlink(path, **options)

    monkeypatch.setattr("fitctl.logging.folder.Path.unlink", refuse)
    pruned = prune(tmp_path, "bench", limits(1, 365), NOW)
    assert pruned.deleted == [gone]
    assert [why.partition(": ")[0] for why in pruned.refused] == [str(folder), str(stuck)]


def test_one_log_that_cannot_be_examined_keeps_none_of_the_others(tmp_path):
    stuck, gone = (tmp_path / name_of(day) for day in (1, 2))
    stuck.symlink_to(stuck.name)  # leads to itself
    aged(tmp_path, gone.name, 401, 10)
    pruned = prune(tmp_path, "bench", limits(1, 365), NOW)

    assert pruned.deleted == [gone]
    assert [why.partition(": ")[0] for why in pruned.refused] == [str(stuck)]


def test_recording_goes_on_where_something_else_has_an_old_logs_name(tmp_path):
    folder = tmp_path / name_of(1)
    folder.mkdir()
    os.utime(folder, (0, 0))
    with RotatingLog(SETTINGS, "bench", tmp_path) as log:
        log.write(tick(1), WALL_S)
        assert log.pop_notes() == [
            (
                "warning",
                f"{folder}: cannot be opened: not a regular file; a log is a file that may be read",
            )
        ]
    assert len(contents(log.path)) == 1


def test_a_limit_that_would_leave_no_finished_file_is_refused():
    document = SETTINGS.model_dump() | {"rotate_bytes": 1_000_000, "retain_bytes": 1_999_999}
    with pytest.raises(ValidationError, match="retain_bytes: must be at least"):
        Logging(**document)


def test_a_log_that_is_deleted_while_the_folder_is_listed_is_not_called_unreadable(
    tmp_path, monkeypatch
):
    recorded(SETTINGS, tmp_path, 1)
    (gone := tmp_path / "old.mcap").write_bytes(b"")

    def late_info(path):
        gone.unlink(missing_ok=True)
        return log_info(path)

    monkeypatch.setattr("fitctl.logging.listing.log_info", late_info)
    logs, problems = logs_in(tmp_path)

    assert len(logs) == 1
    assert problems == {}


def test_names_tell_rig_and_start_and_never_clash(tmp_path):
    start = datetime(2026, 11, 21, 8, 9, 10, tzinfo=UTC)
    names = []
    for _ in range(3):
        path = new_log_path(tmp_path / "new", "fit-mock", start)
        path.touch()
        names.append(path.name)
    assert names == [
        "fit-mock_20261121T080910Z.mcap",
        "fit-mock_20261121T080910Z_2.mcap",
        "fit-mock_20261121T080910Z_3.mcap",
    ]


def test_a_file_that_cannot_be_begun_leaves_none_behind(tmp_path):
    full = pytest.raises(LogError, match=r"a\.mcap: cannot be written: File too large")
    with files_end_at(10), full:
        LogWriter(tmp_path / "a.mcap", SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_what_is_flushed_is_on_the_disk_before_it_is_confirmed(tmp_path, monkeypatch):
    """A power cut takes what the operating system still holds; only the disk counts."""
    synced = []
    real = os.fdatasync
    monkeypatch.setattr(
        "fitctl.logging.writer.os.fdatasync",
        lambda descriptor: (synced.append(os.fstat(descriptor).st_size), real(descriptor)),
    )
    with LogWriter(tmp_path / "a.mcap", SETTINGS) as writer:
        writer.write(tick(1), time.time())
        writer.flush()
        assert synced[-1] == writer.bytes_written == writer.path.stat().st_size
    assert synced[-1] == writer.path.stat().st_size
