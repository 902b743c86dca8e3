import io
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from samples.forged_logs import forged
from samples.log_samples import (
    RUN_INFO,
    SETTINGS,
    WALL_S,
    contents,
    files_end_at,
    filled,
    frame,
    one_of_each,
    tick,
    write_log,
)

from fitctl.logging.errors import LogError
from fitctl.logging.indexed import IndexedReader
from fitctl.logging.reading import HEADER, column_blocks, log_info, read_records, tick_arrays
from fitctl.logging.records import Event
from fitctl.logging.schemas import to_message, topic_of
from fitctl.logging.writer import LogWriter

NOBODY = 65534


def write_frames(writer, number):
    for index in range(number):
        writer.write(frame(index), WALL_S)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_was_written_is_read(tmp_path, compression):
    records = one_of_each()
    chosen = SETTINGS.model_copy(update={"compression": compression})
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, *records], chosen)

    entries = list(read_records(path))

    assert [entry.topic for entry in entries] == [topic_of(record) for record in records]
    for number, (entry, record) in enumerate(zip(entries, records, strict=True), start=1):
        own_ns = round((record.time_s + RUN_INFO.wall_minus_monotonic_s) * 1e9)
        expected = to_message(record, own_ns).SerializeToString(deterministic=True)
        assert entry.message.SerializeToString(deterministic=True) == expected
        assert entry.publish_time_ns == own_ns
        assert entry.log_time_ns == round((WALL_S + number) * 1e9)


def test_ticks_and_frames_keep_their_numbers(tmp_path):
    path = write_log(tmp_path / "a.mcap", [tick(8), frame(41), tick(9), *one_of_each()[2:3]])
    assert [entry.sequence for entry in read_records(path)] == [8, 41, 9, 1]


def test_a_block_with_a_long_text_has_fewer_rows(tmp_path):
    """An array of texts has room for the longest one in every row."""
    long = [
        filled(Event, severity="info", message="x" * (1_000_000 if number == 3 else 1))
        for number in range(20)
    ]
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, *long])

    blocks = [columns["message"] for _, columns in column_blocks(path, rows=2000)]

    assert [text for block in blocks for text in block] == [event.message for event in long]
    assert max(block.nbytes for block in blocks) < 30e6


def test_a_log_whose_index_counts_no_messages_is_damaged(tmp_path):
    source = write_log(tmp_path / "a.mcap", [RUN_INFO, tick(1)])

    def add(writer):
        writer._Writer__statistics.message_count = 0

    path = forged(source, tmp_path / "b.mcap", lambda _: None, add)

    with pytest.raises(LogError, match="its index counts 0 messages, and 1 by channel"):
        log_info(path)


def test_topics_can_be_chosen(tmp_path):
    path = write_log(tmp_path / "a.mcap", one_of_each())
    topics = ["/fit/events", "/fit/right/piezo"]
    assert [entry.topic for entry in read_records(path, topics)] == topics


def test_of_a_topic_only_some_fields_can_be_had(tmp_path):
    path = write_log(tmp_path / "a.mcap", [tick(7), frame(1), *one_of_each()[2:3]])
    blocks = dict(column_blocks(path, fields={"/fit/right/tick": ["late", "number", "colour"]}))
    assert set(blocks["/fit/right/tick"]) == {*HEADER, "number", "late"}
    assert blocks["/fit/right/tick"]["number"].tolist() == [7]
    assert "width" in blocks["/fit/camera/frame"]


@pytest.mark.parametrize(
    "topics", [None, ["/fit/right/tick"], ["/fit/camera/frame", "/fit/events"], []]
)
def test_a_log_is_read_as_the_library_s_own_reader_reads_it(tmp_path, topics):
    records = [record for n in range(40) for record in (tick(n), frame(n))]
    small = SETTINGS.model_copy(update={"chunk_bytes": 10_000})
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, *records, *one_of_each()[2:]], small)
    ours, whole = (
        list(reader(io.BytesIO(path.read_bytes())).iter_messages(topics, log_time_order=False))
        for reader in (IndexedReader, SeekingReader)
    )
    assert ours == whole
    assert bool(ours) == (topics != [])


def test_before_the_run_info_the_writer_measures_the_wall_time_itself(tmp_path):
    path = write_log(tmp_path / "a.mcap", [tick(1, time_s=time.monotonic())])
    (entry,) = read_records(path)
    assert abs(entry.publish_time_ns / 1e9 - time.time()) < 10


def test_ticks_as_arrays(tmp_path):
    others = [tick(9, loop="left"), frame(1)]
    ticks = [tick(n, late=n == 1, mode="COARSE" if n == 0 else "VERNIER") for n in range(3)]
    arrays = tick_arrays(write_log(tmp_path / "a.mcap", [*others, *ticks]), "right")
    np.testing.assert_array_equal(arrays["number"], np.array([0, 1, 2], np.int64))
    np.testing.assert_array_equal(arrays["time_s"], [100.0, 100.02, 100.04])
    np.testing.assert_array_equal(arrays["mode"], ["COARSE", "VERNIER", "VERNIER"])
    assert arrays["late"].dtype == np.bool_
    assert list(arrays) == list(type(ticks[0]).__struct_fields__)


def test_a_loop_without_ticks_is_named_with_what_is_there(tmp_path):
    path = write_log(tmp_path / "a.mcap", [tick(1)])
    with pytest.raises(LogError, match=r"'left'.*/fit/right/tick"):
        tick_arrays(path, "left")


def test_info_of_a_finished_log(tmp_path):
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, tick(1), tick(2), frame(1), RUN_INFO])
    info = log_info(path)
    assert info.finished
    assert info.counts == {"/fit/right/tick": 2, "/fit/camera/frame": 1}
    assert (info.start_s, info.duration_s) == (WALL_S + 1, 2.0)
    assert info.metadata["versions"] == {"fitctl": "0.1.0"}


def test_info_of_a_cut_log_says_the_same_but_that_it_is_cut(tmp_path):
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, SETTINGS)
    for number, record in enumerate([RUN_INFO, tick(1), tick(2), frame(1)]):
        writer.write(record, WALL_S + number)
    writer.flush()
    info = log_info(path)
    writer.close()
    assert not info.finished
    assert (info.counts, info.metadata, info.start_s, info.end_s) == (
        log_info(path).counts,
        log_info(path).metadata,
        log_info(path).start_s,
        log_info(path).end_s,
    )


def test_an_empty_log_is_a_log(tmp_path):
    path = write_log(tmp_path / "a.mcap", [])
    assert list(read_records(path)) == []
    assert np.isnan(log_info(path).duration_s)


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def whole_log(request, tmp_path_factory):
    chosen = SETTINGS.model_copy(update={"compression": request.param})
    records = [RUN_INFO, *(record for n in range(12) for record in (tick(n), frame(n)))]
    path = write_log(tmp_path_factory.mktemp("logs") / "whole.mcap", records, chosen)
    return path, contents(path)


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_a_log_cut_anywhere_reads_up_to_the_cut(whole_log, data):
    path, whole = whole_log
    content = path.read_bytes()
    cut = path.with_name("cut.mcap")
    cut.write_bytes(content[: data.draw(st.integers(8, len(content) - 1), label="cut after")])
    found = contents(cut)
    assert found == whole[: len(found)]
    assert sum(log_info(cut).counts.values()) == len(found)


def test_flushed_records_survive_whatever_follows(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", SETTINGS)
    for number in range(5):
        writer.write(tick(number), WALL_S)
    writer.flush()
    writer.write(tick(5), WALL_S)
    assert list(tick_arrays(writer.path, "right")["number"]) == [0, 1, 2, 3, 4]
    writer.close()


def test_damage_in_a_finished_log_is_an_error(tmp_path):
    path = write_log(tmp_path / "a.mcap", [frame(n) for n in range(12)])
    content = bytearray(path.read_bytes())
    content[20000] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(LogError, match="is damaged"):
        list(read_records(path))


@pytest.mark.parametrize("content", [b"", b"hello", b"TIME,AZ,EL\n1,2,3\n"])
def test_something_else_is_no_log(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match="is not an MCAP log"):
        log_info(path)


def test_a_missing_log_is_named(tmp_path):
    with pytest.raises(LogError, match=r"none\.mcap: cannot be opened: No such file"):
        list(read_records(tmp_path / "none.mcap"))


def test_a_log_is_never_overwritten(tmp_path):
    path = write_log(tmp_path / "a.mcap", [tick(1)])
    with pytest.raises(LogError, match="exists already"):
        LogWriter(path, SETTINGS)
    assert log_info(path).finished


def test_a_read_only_folder_is_named_with_the_next_step():
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o555)
        user = os.geteuid()
        if user == 0:  # root may write anywhere
            os.seteuid(NOBODY)
        try:
            with pytest.raises(LogError, match=r"a\.mcap: cannot be written.*logging\.folder"):
                LogWriter(Path(name) / "a.mcap", SETTINGS)
        finally:
            os.seteuid(user)


def test_a_full_disk_is_one_clear_error_and_the_log_stays_readable(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", SETTINGS)
    with files_end_at(50_000):
        with pytest.raises(LogError, match=r"a\.mcap: cannot be written: File too large.*room"):
            write_frames(writer, 100)
        with pytest.raises(LogError, match="an earlier write failed"):
            writer.write(frame(100), WALL_S)
        writer.close()
        writer.close()
    assert 6 <= len(list(read_records(writer.path))) <= 15


@pytest.mark.parametrize(
    "record",
    [tick(1, time_s=float("nan")), tick(1, time_s=-1e12), tick(2**63)],
    ids=["time is NaN", "time before 1970", "number too large"],
)
def test_a_record_that_cannot_be_written_leaves_the_log_as_it_was(tmp_path, record):
    with LogWriter(tmp_path / "a.mcap", SETTINGS) as writer:
        writer.write(tick(0), WALL_S)
        with pytest.raises(ValueError, match=r".+"):
            writer.write(record, WALL_S)
        writer.write(tick(2), WALL_S)
    assert list(tick_arrays(writer.path, "right")["number"]) == [0, 2]
