"""Whether a log is what its recorder meant to write."""

from __future__ import annotations

import os
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.records import Channel, DataEnd, Footer, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from fitctl.logging.copying import is_recoverable, recoverable
from fitctl.logging.errors import ForeignTopicError, LogError
from fitctl.logging.files import DAMAGE, MEND, Described, damaged, opened
from fitctl.logging.folder import in_use
from fitctl.logging.reading import log_info, own_times_s, read_records
from fitctl.logging.records import FrameRecord, RecorderStatus
from fitctl.logging.schemas import TOPICS

_AFTER_SUMMARY_BYTES = 4 + len(
    MCAP0_MAGIC
)  # what the summary's checksum does not cover: itself, the end


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is in a log and what is wrong with it.

    Attributes
    ----------
    records : int
        That were read.
    lost : int
        By the recorder's own count since it was started.
    frames_missing : int
        Gaps in the camera's numbers of the frames.
    problems : tuple of str
        Empty for a whole log.
    """

    records: int
    lost: int
    frames_missing: int
    problems: tuple[str, ...]


def verify(path: Path) -> Verdict:
    """Read a log from end to end: checksums, index against contents, order, every message, every frame's size.

    Raises
    ------
    LogError
        If it is missing, no MCAP log at all, or has topics in another format than protobuf.
    """
    with opened(path) as (stream, finished):
        in_order, problems = (
            _checked(path, stream) if finished else (Counter(), [_unfinished(path)])
        )
    if finished and problems:  # what its messages say is not worth reading
        sound = recoverable(path)
        problems.append(
            f"{sound.damaged_chunks} damaged chunks; the other chunks have {sound.records} records"
        )
        return Verdict(sound.records, 0, 0, tuple(problems))
    counts: Counter[str] = Counter()
    lost = last_lost = frames_missing = newest_ns = misdated = 0
    first_misdated = ""
    foreign: dict[str, str] = {}
    last_frame: int | None = None
    try:
        info = log_info(path)
        first_s, last_s = own_times_s(info, info.start_s, info.end_s)
        for entry in read_records(path):  # by the index, if there is one
            message: Any = entry.message
            counts[entry.topic] += 1
            if entry.log_time_ns < newest_ns:
                problems.append(f"record {counts.total()} ({entry.topic}): its log time goes back")
            newest_ns = entry.log_time_ns
            if not first_s <= entry.publish_time_ns / 1e9 <= last_s:
                misdated += 1
                first_misdated = first_misdated or f"record {counts.total()} ({entry.topic})"
            try:
                if entry.topic == TOPICS[RecorderStatus]:
                    now_lost = message.lost  # counts on while one recorder lives
                    lost += now_lost - last_lost if now_lost >= last_lost else now_lost
                    last_lost = now_lost
                elif entry.topic == TOPICS[FrameRecord]:
                    # The camera's numbers begin anew at times.
                    before = entry.sequence if last_frame is None else last_frame
                    frames_missing += max(0, entry.sequence - before - 1)
                    last_frame = entry.sequence
                    if len(message.data) != message.step * message.height:
                        problems.append(
                            f"frame {entry.sequence}: the size of its data does not match its header"
                        )
            except (AttributeError, TypeError):  # a message of another program, with other fields
                foreign[entry.topic] = message.DESCRIPTOR.full_name
        problems += [
            f"{topic}: has messages of type {kind}, whose fields are not those that fitctl records; another "
            "program wrote them, and nothing is counted of them"
            for topic, kind in foreign.items()
        ]
        if misdated:
            problems.append(
                f"{first_misdated}: its own time is more than a day outside the log's; {misdated} records are "
                "so, and reports leave them out"
            )
        if finished and not in_order == counts == Counter(info.counts):
            problems.append(f"its index is not of its contents; {MEND}")
    except ForeignTopicError:
        raise
    except LogError as error:
        problems.append(str(error).removeprefix(f"{path}: "))
    return Verdict(counts.total(), lost, frames_missing, tuple(problems))


def _unfinished(path: Path) -> str:
    if in_use(path):
        return "is being recorded just now; stop the recorder, or look again when it has begun another file"
    return f"is cut off; {MEND}" if is_recoverable(path) else "is cut off before its first record"


def _checked(path: Path, stream: IO[bytes]) -> tuple[Counter[str], list[str]]:
    """Messages by topic of a finished log, as they come in the file, and what its checksums complain of."""
    counts: Counter[str] = Counter()
    channels: Described[Channel] = Described(path)
    ends: list[DataEnd | Footer] = []
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    try:
        for record in StreamReader(stream, validate_crcs=True, record_size_limit=size).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                counts[channels[record.channel_id].topic] += 1
            elif isinstance(record, DataEnd | Footer):
                ends.append(record)
        footer = ends[-1]
        if len(ends) != 2 or not isinstance(footer, Footer):
            return counts, [f"is damaged: its index is not where it should be; {MEND}"]
        stream.seek(footer.summary_start)
        summary_crc = zlib.crc32(stream.read(size - _AFTER_SUMMARY_BYTES - footer.summary_start))
    except DAMAGE as error:
        return counts, [damaged(error)]
    if footer.summary_crc not in {0, summary_crc}:
        return counts, [f"its index is damaged: wrong checksum; {MEND}"]
    return counts, []
