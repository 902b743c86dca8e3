"""Recovered, cut and merged logs."""

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from samples.log_samples import (
    RUN_INFO,
    SETTINGS,
    SMALL_CHUNKS,
    WALL_S,
    contents,
    files_end_at,
    frame,
    one_of_each,
    tick,
    write_log,
)

from fitctl.logging.copying import cut, merge, recover
from fitctl.logging.errors import LogError
from fitctl.logging.files import COPY, RECOVERED
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.verifying import verify
from fitctl.logging.writer import LogWriter
from fitctl.replay.log import whole_run
from fitctl.report.run import find_run

FOREVER_NS = 2**63
COPIED = {COPY: {"by": "fitctl log"}}
RECORDS = [RUN_INFO, *(record for n in range(12) for record in (tick(n), frame(n)))]


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def whole(request, tmp_path_factory):
    """A finished log of many chunks, and what is in it."""
    chosen = SMALL_CHUNKS.model_copy(update={"compression": request.param})
    path = write_log(tmp_path_factory.mktemp("logs") / "whole.mcap", RECORDS, chosen)
    return path, contents(path)


def recovered(path, content):
    """Recover this content; None where nothing could be saved."""
    broken, target = path.with_name("broken.mcap"), path.with_name("recovered.mcap")
    broken.write_bytes(content)
    target.unlink(missing_ok=True)
    try:
        saved = recover(broken, target)
    except LogError:
        assert not target.exists()
        return None
    assert verify(target).problems == ()
    assert saved.records == len(contents(target))
    return saved, contents(target)


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_a_log_cut_anywhere_is_recovered_up_to_the_cut(whole, data):
    path, everything = whole
    content = path.read_bytes()
    broken = content[: data.draw(st.integers(8, len(content) - 1), label="cut after")]
    result = recovered(path, broken)
    readable = contents(path.with_name("broken.mcap"))
    assert readable == everything[: len(readable)]
    if result is None:
        assert readable == []
    else:
        assert result[1] == readable
        assert result[0].damaged_chunks == 0


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_of_a_log_damaged_anywhere_only_sound_records_are_recovered(whole, data):
    path, everything = whole
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(8, len(content) - 1), label="at")
    content[at] ^= data.draw(st.integers(1, 255), label="flip")
    result = recovered(path, bytes(content))
    if result is not None:
        rest = iter(everything)
        assert all(entry in rest for entry in result[1])  # in their order, none invented


@pytest.mark.long
def test_a_damaged_index_costs_nothing(whole):
    """A topic is described in it, too: what the chunks say of it comes first."""
    path, everything = whole
    content = path.read_bytes()
    for at in range(content.rindex(b"fitctl.Tick"), len(content) - 8, 37):
        damaged = bytearray(content)
        damaged[at] ^= 1
        saved, found = recovered(path, bytes(damaged))
        assert saved.records == len(everything)
        assert found == everything


def test_one_damaged_chunk_costs_its_own_records_only(whole):
    path, everything = whole
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    saved, found = recovered(path, bytes(content))
    assert (saved.damaged_chunks, saved.unread_bytes) == (1, 0)
    assert len(everything) - 6 <= len(found) < len(everything)
    assert found[-1] == everything[-1]


def test_the_runs_description_is_recovered_too(whole):
    path, _ = whole
    recovered(path, path.read_bytes()[:20_000])
    described = log_info(path.with_name("recovered.mcap")).metadata
    assert described == log_info(path).metadata | {COPY: COPIED[COPY] | {RECOVERED: "broken.mcap"}}


def test_a_log_without_a_whole_record_is_refused_and_nothing_is_left(tmp_path):
    path = write_log(tmp_path / "a.mcap", [RUN_INFO])
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(LogError, match=r"a\.mcap: holds no whole record"):
        recover(path, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "copy",
    [
        recover,
        lambda a, b: cut(a, b, from_ns=0, to_ns=FOREVER_NS),
        lambda a, b: merge([a], b),
    ],
    ids=["recover", "cut", "merge"],
)
def test_nothing_is_overwritten_unasked(tmp_path, copy):
    path = write_log(tmp_path / "a.mcap", one_of_each())
    target = tmp_path / "b.mcap"
    target.write_bytes(b"precious")
    with pytest.raises(LogError, match=r"b\.mcap: exists already"):
        copy(path, target)
    assert target.read_bytes() == b"precious"


def test_a_log_can_be_recovered_in_place_if_asked(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS, SMALL_CHUNKS)
    everything = contents(path)
    path.write_bytes(path.read_bytes()[:-5])
    recover(path, path, overwrite=True)
    assert contents(path) == everything
    assert verify(path).problems == ()


def test_a_log_that_is_being_recorded_is_never_overwritten(tmp_path):
    path = write_log(tmp_path / "a.mcap", one_of_each())
    with LogWriter(tmp_path / "b.mcap", SETTINGS) as writer:
        with pytest.raises(LogError, match=r"b\.mcap: is being recorded"):
            recover(path, writer.path, overwrite=True)
        writer.write(tick(1), WALL_S)
    assert len(contents(writer.path)) == 1


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS)
    full = pytest.raises(LogError, match=r"b\.mcap: cannot be written: File too large")
    with files_end_at(10_000), full:
        merge([path], tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == [path]


def test_a_cut_has_the_chosen_time_and_topics_and_the_runs_description(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS, SMALL_CHUNKS)
    target = tmp_path / "b.mcap"
    first_ns = round((WALL_S + 1) * 1e9)
    span = {"from_ns": first_ns + 2 * 10**9, "to_ns": first_ns + 8 * 10**9}
    assert cut(path, target, **span) == 6
    assert contents(target) == contents(path)[2:8]
    assert cut(path, target, **span, topics=["/fit/right/tick"], overwrite=True) == 3
    assert [entry.sequence for entry in read_records(target)] == [1, 2, 3]
    assert log_info(target).metadata == log_info(path).metadata | COPIED
    assert verify(target).problems == ()


def test_a_cut_without_records_is_refused(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS)
    with pytest.raises(LogError, match="has no record of these topics in that time"):
        cut(path, tmp_path / "b.mcap", from_ns=0, to_ns=1)


def test_a_damaged_log_is_neither_cut_nor_merged_without_saying_so(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS, SMALL_CHUNKS)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    for copy in (
        lambda: cut(path, tmp_path / "b.mcap", from_ns=0, to_ns=FOREVER_NS),
        lambda: merge([path], tmp_path / "b.mcap"),
    ):
        with pytest.raises(LogError, match=r"a\.mcap: is damaged.*recover"):
            copy()
    assert list(tmp_path.iterdir()) == [path]


@given(
    owners=st.lists(st.integers(0, 2), min_size=1, max_size=40),
    again=st.integers(0, 5),
)
@settings(max_examples=25, deadline=None)
def test_a_merged_log_has_every_record_once_in_order(tmp_path_factory, owners, again):
    """Each record is in one of three logs; the third begins with the last ones of the first."""
    folder = tmp_path_factory.mktemp("merge")
    logs = [[], [], []]
    for number, owner in enumerate(owners):
        logs[owner].append((tick(number), WALL_S + number))
    doubles = logs[0][len(logs[0]) - min(again, len(logs[0])) :] if again else []
    late_s = WALL_S + len(owners)
    logs[2] += [(record, late_s + 1) for record, _ in doubles]
    for name, records in enumerate(logs):
        with LogWriter(folder / f"{name}.mcap", SETTINGS) as writer:
            writer.write(RUN_INFO, WALL_S)
            for record, log_time_s in records:
                writer.write(record, log_time_s)
    target = folder / "merged.mcap"
    assert merge([folder / f"{n}.mcap" for n in range(3)], target) == (len(owners), len(doubles))
    assert [entry.sequence for entry in read_records(target)] == list(range(len(owners)))
    assert verify(target).problems == ()
    assert log_info(target).metadata == log_info(folder / "0.mcap").metadata | COPIED


def test_records_that_only_a_damaged_chunk_describes_are_counted(tmp_path):
    ticks, frames = map(tick, range(80)), map(frame, range(80, 90))
    whole = write_log(tmp_path / "whole.mcap", [RUN_INFO, *ticks, *frames], SMALL_CHUNKS)
    content = bytearray(whole.read_bytes())
    with whole.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    first = min(index.chunk_start_offset for index in summary.chunk_indexes)
    end = max(index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes)
    content[first + 200] ^= 255
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(content[:end])  # without its index, which describes the topics too

    saved = recover(broken, tmp_path / "recovered.mcap")

    assert saved.damaged_chunks == 1
    everything = len(contents(whole))
    assert 0 < saved.undescribed < everything
    assert saved.records + saved.undescribed < everything  # the rest was in the damaged chunk
    assert log_info(tmp_path / "recovered.mcap").counts.keys() < log_info(whole).counts.keys()


def test_log_times_that_go_back_are_mended_and_counted(tmp_path):
    path, target = tmp_path / "a.mcap", tmp_path / "mended.mcap"
    with LogWriter(path, SETTINGS) as writer:
        for number, later_s in enumerate((0.0, 5.0, 1.0, 5.0, 3.0, 6.0)):
            writer.write(frame(number), WALL_S + later_s)

    saved = recover(path, target)

    assert (saved.records, saved.went_back) == (6, 2)
    assert verify(target).problems == ()
    assert [entry.sequence for entry in read_records(target)] == [
        entry.sequence for entry in read_records(path)
    ]
    for copy in (lambda: merge([path, target], tmp_path / "b.mcap"), lambda: cut_all(path)):
        with pytest.raises(
            LogError, match=r"a\.mcap: is damaged; repair it with `fitctl log recover`"
        ):
            copy()


def cut_all(path):
    return cut(path, path.with_name("cut.mcap"), from_ns=0, to_ns=FOREVER_NS)


def test_a_log_says_of_how_many_runs_it_is(tmp_path):
    one = write_log(tmp_path / "one.mcap", RECORDS)
    later = msgspec.structs.replace(RUN_INFO, time_s=900.0)
    other = write_log(tmp_path / "other.mcap", [later, *RECORDS[1:]], start_s=WALL_S + 800.0)
    merge([one, other], tmp_path / "night.mcap")

    assert [log_info(path).runs for path in (one, other, tmp_path / "night.mcap")] == [1, 1, 2]
    with pytest.raises(LogError, match=r"night\.mcap: holds 2 runs"):
        find_run([tmp_path / "night.mcap"])
    with (
        pytest.raises(LogError, match=r"night\.mcap: holds 2 runs"),
        whole_run([tmp_path / "night.mcap"]),
    ):
        pass
