"""A log is read from any time on, finished or torn, and never more of it than is allowed."""

import struct

import pytest
from mcap.opcode import Opcode

from fitctl.logging import seeking
from fitctl.logging.errors import LogError
from fitctl.logging.reading import read_records
from fitctl.logging.records import Event
from fitctl.logging.seeking import SeekableLog
from fitctl.logging.writer import LogWriter
from tests.samples.log_samples import RUN_INFO, SMALL_CHUNKS, WALL_S

COUNT = 2000


def event(number):
    return Event(
        time_s=WALL_S - RUN_INFO.wall_minus_monotonic_s + number,
        severity="info",
        source="test",
        message=f"number {number}",
    )


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, SMALL_CHUNKS) as writer:
        writer.write(RUN_INFO, WALL_S)
        for number in range(COUNT):
            writer.write(event(number), WALL_S + number)
    return path


def numbers(log, from_s, to_s):
    entries = log.messages(round((WALL_S + from_s) * 1e9), round((WALL_S + to_s) * 1e9))
    return [int(entry.message.message.split()[1]) for entry in entries]


def test_only_the_messages_of_a_time_are_read(path):
    log = SeekableLog(path)
    assert numbers(log, 700, 710) == list(range(700, 711))
    assert log.span_ns == (round(WALL_S * 1e9), round((WALL_S + COUNT - 1) * 1e9))
    assert log.metadata["rig"]["name"] == RUN_INFO.rig_name


def test_each_chunk_is_unpacked_once_whatever_channels_its_indexes_name(path, monkeypatch):
    last = max(SeekableLog(path)._chunks, key=lambda chunk: chunk.offset)
    end = last.offset + 9 + last.size
    strange = [struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6, 1000 + n, 0) for n in range(500)]
    path.write_bytes(path.read_bytes()[:end] + b"".join(strange))
    unpack, unpacked = SeekableLog._unpack, []

    def counted(log, stream, place):
        unpacked.append(place.offset)
        return unpack(log, stream, place)

    monkeypatch.setattr(SeekableLog, "_unpack", counted)
    log = SeekableLog(path)

    assert unpacked.count(last.offset) == 1
    assert numbers(log, 700, 710) == list(range(700, 711))


def test_a_torn_log_is_read_to_its_tear(path):
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    readable = [int(entry.message.message.split()[1]) for entry in read_records(path)]
    assert 100 < len(readable) < COUNT
    assert numbers(SeekableLog(path), 0, COUNT) == readable


def test_a_damaged_chunk_is_left_out_and_counted(path):
    log = SeekableLog(path)
    place = log._chunks[len(log._chunks) // 2]
    content = bytearray(path.read_bytes())
    content[place.offset + place.size // 2] ^= 0xFF
    path.write_bytes(content)
    log = SeekableLog(path)
    found = numbers(log, 0, COUNT)
    assert log.damaged == 1
    assert 0 < COUNT - len(found) < 200


def test_damage_in_the_first_chunk_costs_that_chunk_only(path):
    first = SeekableLog(path)._chunks[0]
    content = bytearray(path.read_bytes())
    content[first.offset + first.size // 2] ^= 0xFF
    path.write_bytes(content)

    log = SeekableLog(path)
    found = numbers(log, 0, COUNT)

    assert log.damaged == 1
    assert 0 < COUNT - len(found) < 200


def test_other_topics_are_passed_over_without_unpacking(path):
    log = SeekableLog(path)
    log._unpack = None
    assert list(log.messages(0, 2**63, ["/fit/none"])) == []


def test_no_more_is_unpacked_than_is_allowed(path):
    with pytest.raises(LogError, match="would have to be read at once"):
        list(SeekableLog(path).messages(0, 2**63, most_bytes=20_000))


def test_a_flood_of_chunks_is_refused(path, monkeypatch):
    monkeypatch.setattr(seeking, "MOST_CHUNKS", 5)
    with pytest.raises(LogError, match="more than 5 chunks"):
        SeekableLog(path)


def test_a_log_that_is_gone_is_named(path):
    log = SeekableLog(path)
    path.unlink()
    with pytest.raises(LogError, match=r"log\.mcap"):
        numbers(log, 0, 10)
