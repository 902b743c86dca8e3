"""What is said of a log that is whole, and of one that is not."""

import contextlib

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC
from samples.forged_logs import forged, with_messages_of_another_program
from samples.log_samples import (
    RUN_INFO,
    SETTINGS,
    SMALL_CHUNKS,
    WALL_S,
    filled,
    frame,
    one_of_each,
    tick,
    write_log,
)

from fitctl.logging.copying import recover, recoverable
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.records import Event, RecorderStatus
from fitctl.logging.seeking import SeekableLog
from fitctl.logging.verifying import verify
from fitctl.logging.writer import LogWriter


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_finished_log_is_whole(tmp_path, compression):
    chosen = SETTINGS.model_copy(update={"compression": compression, "chunk_bytes": 4096})
    records = [RUN_INFO, *one_of_each()[2:], *(frame(n) for n in range(20))]
    verdict = verify(write_log(tmp_path / "a.mcap", records, chosen))
    assert (verdict.records, verdict.problems) == (26, ())


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_any_changed_byte_is_noticed(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "changed.mcap"
    path.unlink(missing_ok=True)
    write_log(path, [RUN_INFO, *(frame(n) for n in range(4)), tick(1)])
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(len(MCAP0_MAGIC), len(content) - 1), label="at")
    content[at] ^= data.draw(st.integers(1, 255), label="flip")
    path.write_bytes(content)
    assert verify(path).problems != ()
    for read in (log_info, lambda path: list(read_records(path))):
        with contextlib.suppress(LogError):  # and nothing else
            read(path)


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_any_cut_is_noticed(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "short.mcap"
    path.unlink(missing_ok=True)
    write_log(path, [RUN_INFO, *(frame(n) for n in range(4)), tick(1)])
    content = path.read_bytes()
    path.write_bytes(content[: data.draw(st.integers(8, len(content) - 1), label="cut after")])
    (problem,) = verify(path).problems
    assert problem.startswith("is cut off")
    assert ("`fitctl log recover`" in problem) == (recoverable(path).records > 0)


def test_damaged_chunks_are_counted_and_what_the_others_hold(tmp_path):
    events = [Event(time_s=n, severity="info", source="x", message="y" * 99) for n in range(300)]
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, *events], SMALL_CHUNKS)
    content = bytearray(path.read_bytes())
    chunks = SeekableLog(path)._chunks
    for place in (chunks[1], chunks[-2]):
        content[place.offset + place.size // 2] ^= 0xFF
    path.write_bytes(content)

    verdict = verify(path)

    assert 0 < verdict.records < len(events)
    assert verdict.problems[0].startswith("is damaged: ")
    assert verdict.problems[1:] == (
        f"2 damaged chunks; the other chunks have {verdict.records} records",
    )
    assert recover(path, tmp_path / "b.mcap").records == verdict.records


def test_a_log_that_is_being_recorded_is_not_called_cut(tmp_path):
    with LogWriter(tmp_path / "a.mcap", SETTINGS) as writer:
        (problem,) = verify(writer.path).problems
    assert "being recorded just now" in problem


def test_losses_are_told_from_damage(tmp_path):
    status = [filled(RecorderStatus, path=p, lost=n) for p, n in (("a", 2), ("a", 5), ("b", 1))]
    records = [frame(7), frame(8), frame(11), frame(65535), frame(1), *status]
    verdict = verify(write_log(tmp_path / "a.mcap", records))
    assert verdict.lost == 6
    assert verdict.frames_missing == 2 + 65523
    assert verdict.problems == ()


def test_a_frame_that_is_not_as_large_as_it_says_and_a_time_that_goes_back_are_named(tmp_path):
    with LogWriter(tmp_path / "a.mcap", SETTINGS) as writer:
        writer.write(one_of_each()[1], WALL_S)
        writer.write(filled(type(frame(1)), number=9, width_px=40, height_px=40), WALL_S - 1)
    problems = verify(writer.path).problems
    assert problems == (
        "record 2 (/fit/camera/frame): its log time goes back",
        "frame 9: the size of its data does not match its header",
    )


def test_records_whose_own_time_is_not_the_logs_are_named(tmp_path):
    whole = write_log(tmp_path / "a.mcap", [RUN_INFO, *(tick(n) for n in range(1, 6))])
    wrong_ns = {2: 2**62, 4: 0}
    path = forged(whole, tmp_path / "b.mcap", lambda record: wrong_ns.get(record.sequence))

    assert verify(whole).problems == ()
    assert verify(path).problems == (
        "record 2 (/fit/right/tick): its own time is more than a day outside the log's; 2 records are so, and "
        "reports leave them out",
    )


@pytest.mark.parametrize("topic", ["/fit/recorder/status", "/fit/camera/frame"])
def test_messages_of_another_type_under_a_topic_of_fitctl_are_one_problem(tmp_path, topic):
    path = with_messages_of_another_program(tmp_path / "b.mcap", topic, Log(message="x"))

    verdict = verify(path)

    assert (verdict.records, verdict.lost, verdict.frames_missing) == (3, 0, 0)
    (problem,) = verdict.problems
    assert problem.startswith(f"{topic}: has messages of type foxglove.Log, ")


def test_what_is_no_log_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"hello")
    with pytest.raises(LogError, match="is not an MCAP log"):
        verify(path)
