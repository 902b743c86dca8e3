"""Reading logs back, finished or cut off.

A recorder that was killed leaves a file without its index and with a torn end; that is read from the
start for as far as it makes sense, which is at least its last flush.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import google.protobuf.message
import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.well_known import MessageEncoding
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from fitctl.logging.errors import ForeignTopicError, LogError
from fitctl.logging.files import Described, opened, up_to_the_tear
from fitctl.logging.indexed import IndexedReader
from fitctl.logging.records import MOST, Tick
from fitctl.logging.schemas import TOPICS

_CLOCK_SET_S = 86_400.0  # someone may set the machine's clock by so much during a run
# By column: how it is gathered (a type code of the array module; texts in a list) and what it becomes.
_Form = dict[str, tuple[str, Any]]
_COLUMNS: dict[int, tuple[str, Any]] = {
    FieldDescriptor.CPPTYPE_DOUBLE: ("d", np.float64),
    FieldDescriptor.CPPTYPE_INT64: ("q", np.int64),
    FieldDescriptor.CPPTYPE_UINT32: ("q", np.int64),
    FieldDescriptor.CPPTYPE_ENUM: ("q", np.int64),
    FieldDescriptor.CPPTYPE_BOOL: ("b", np.bool_),
    FieldDescriptor.CPPTYPE_STRING: ("", np.str_),
}
_MOST_CHARACTERS = 200_000_000  # of a column of texts, of four bytes each
_BLOCK_CHARACTERS = 5_000_000  # likewise, with which a block of few rows is large enough
Columns = dict[str, NDArray[Any]]
HEADER = ("log_time_ns", "publish_time_ns", "sequence")
"""The columns that every topic has."""


class LogMessage(NamedTuple):
    """One message of a log; times are nanoseconds since 1970.

    Attributes
    ----------
    topic : str
    message : google.protobuf.message.Message
        Protobuf; fields as in :mod:`fitctl.logging.records`, or Foxglove's RawImage and Log.
    log_time_ns : int
        When the recorder had it.
    publish_time_ns : int
        The record's own time.
    sequence : int
        The number of the tick or frame; otherwise counts the topic's messages from 1.
    """

    topic: str
    message: google.protobuf.message.Message
    log_time_ns: int
    publish_time_ns: int
    sequence: int


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What a log holds.

    Attributes
    ----------
    path : Path
    finished : bool
        False if the recorder did not come to write the index: killed, or still recording.
    start_s, end_s : float
        Wall times of the first and the last message, seconds since 1970; NaN without messages.
    counts : dict
        Messages by topic.
    metadata : dict
        The run's description by name: rig, versions, scheduling, clock. Of several runs, the last one's.
    runs : int
        How many there are in it: several, where logs of a night were merged. 0 in a log of another program.
    """

    path: Path
    finished: bool
    start_s: float
    end_s: float
    counts: dict[str, int]
    metadata: dict[str, dict[str, str]]
    runs: int

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return self.end_s - self.start_s


def read_records(path: Path, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
    """Read the messages of a log in the order in which they were written.

    A log that is being recorded, or whose recorder was killed, is read as far as it is whole.

    Parameters
    ----------
    path : Path
        An MCAP log of fitctl.
    topics : collection of str, optional
        Only these, such as ``/fit/right/tick``. :func:`log_info` lists the topics of a log.

    Yields
    ------
    LogMessage
        ``message`` has the fields of the record, with units in their names.

    Raises
    ------
    LogError
        If the file is missing, no MCAP log, or finished and yet damaged.

    Examples
    --------
    >>> squares = [
    ...     entry.message.error_az_px**2
    ...     for entry in read_records(Path("night.mcap"), ["/fit/right/tick"])
    ...     if entry.message.mode == "VERNIER"
    ... ]
    >>> (sum(squares) / len(squares)) ** 0.5 < 0.1
    True
    """
    with opened(path) as (stream, finished), up_to_the_tear(path, finished):
        kind = IndexedReader if finished else NonSeekingReader
        reader = kind(stream, validate_crcs=True)
        # An index is as large in the file as in memory, but chunks unpack to more.
        if isinstance(reader, NonSeekingReader):
            reader._schemas, reader._channels = Described(path), Described(path)
        factory, decoders = DecoderFactory(), dict[int, Callable[[bytes], Any]]()
        # Not ordered by log time: it is already, and sorting a cut file gives nothing at all.
        for schema, channel, entry in reader.iter_messages(topics, log_time_order=False):
            decode = decoders.get(channel.id)
            if decode is None:
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    raise _of_another_format(path, channel, schema)
                decoders[channel.id] = decode
            yield LogMessage(
                channel.topic,
                decode(entry.data),
                entry.log_time,
                entry.publish_time,
                entry.sequence,
            )


def _of_another_format(path: Path, channel: Channel, schema: Schema | None) -> ForeignTopicError:
    form = channel.message_encoding or "no named format"
    if form == MessageEncoding.Protobuf:  # with a schema of another kind
        form = f"protobuf with a schema in {(schema and schema.encoding) or 'no named format'}"
    return ForeignTopicError(
        f"{path}: has topics in another format than fitctl's: {channel.topic} is in {form}; expected protobuf"
    )


def column_blocks(
    path: Path,
    topics: Collection[str] | None = None,
    rows: float = math.inf,
    fields: Mapping[str, Collection[str]] | None = None,
) -> Iterator[tuple[str, Columns]]:
    """Messages as columns, a block of at most so many rows of one topic at a time.

    Parameters
    ----------
    path : Path
    topics : collection of str, optional
        All, unless named.
    rows : int, optional
        Where texts are long, a block has fewer.
    fields : mapping of str to collection of str, optional
        Of a topic that is named here only these of its fields: the others cost time and room.

    Yields
    ------
    topic : str
    columns : dict of str to array, shape (rows,)
        ``log_time_ns`` and ``publish_time_ns`` (since 1970), ``sequence``, and the message's fields in their
        order: float64, int64, bool, text or bytes. What a message cannot say in one column, such as a
        time stamp in two parts, is left out.

    Raises
    ------
    LogError
        If the log cannot be read, a topic's messages do not all have the same columns, or a time does not go
        into one.
    """
    chosen = fields or {}
    blocks: dict[str, _Block] = {}
    classes: dict[str, type] = {}
    forms: dict[str, _Form] = {}
    for entry in _read_for_columns(path, topics):
        if classes.get(entry.topic) is not type(entry.message):
            classes[entry.topic] = type(entry.message)
            form = _form(entry.message, chosen.get(entry.topic))
            if forms.setdefault(entry.topic, form) != form:
                msg = (
                    f"{path}: {entry.topic} has two forms, as in a log merged from logs of two versions of "
                    "fitctl; expected one: read each of those logs by itself"
                )
                raise LogError(msg)
        block = blocks.get(entry.topic)
        if block is None:
            block = blocks[entry.topic] = _Block(forms[entry.topic])
        try:
            block.add(entry)
        except OverflowError:
            msg = (
                f"{path}: {entry.topic} is not as fitctl records it: a record's time is 2**63 ns or more; "
                "expected nanoseconds since 1970: `fitctl log cut` leaves such records out with --to"
            )
            raise LogError(msg) from None
        if len(block) >= rows or (rows < math.inf and block.characters > _BLOCK_CHARACTERS):
            yield entry.topic, block.columns(f"{path}: {entry.topic}")
            del blocks[entry.topic]
    for topic, block in blocks.items():
        yield topic, block.columns(f"{path}: {topic}")


def _read_for_columns(path: Path, topics: Collection[str] | None) -> Iterator[LogMessage]:
    try:
        yield from read_records(path, topics)
    except ForeignTopicError as error:
        msg = f"{error}; leave them out with --topic"
        raise ForeignTopicError(msg) from None


def tick_arrays(path: Path, loop: str) -> Columns:
    """Every field of one loop's ticks as an array over ticks.

    Returns
    -------
    dict of str to array, shape (ticks,)
        Named as in :class:`~fitctl.logging.records.Tick`: float64, int64 or bool, and text for the mode.

    Raises
    ------
    LogError
        If the log cannot be read, or has no ticks of this loop.
    """
    for _, columns in column_blocks(path, [TOPICS[Tick].format(loop=loop)]):
        return {name: column for name, column in columns.items() if name not in HEADER}
    topics = ", ".join(sorted(log_info(path).counts)) or "none"
    msg = f"{path}: has no ticks of loop {loop!r}; topics in this log: {topics}"
    raise LogError(msg)


def _form(message: google.protobuf.message.Message, chosen: Collection[str] | None) -> _Form:
    """A message's columns, by the fields of the file, which may be older than this code."""
    form = {}
    for field in message.DESCRIPTOR.fields:
        if field.cpp_type in _COLUMNS and (chosen is None or field.name in chosen):
            # Only the type distinguishes text from bytes.
            is_bytes = field.type == FieldDescriptor.TYPE_BYTES
            form[field.name] = ("", np.object_) if is_bytes else _COLUMNS[field.cpp_type]
    return form


class _Block:
    """Messages of one topic, field by field."""

    def __init__(self, form: _Form) -> None:
        kinds = dict.fromkeys(HEADER, _COLUMNS[FieldDescriptor.CPPTYPE_INT64]) | form
        self._dtypes = {name: dtype for name, (_, dtype) in kinds.items()}
        self._values: dict[str, Any] = {
            name: array(code) if code else [] for name, (code, _) in kinds.items()
        }
        self._header = [self._values[name] for name in HEADER]
        self._fields = [(name, self._values[name]) for name in form]
        self._longest = {name: 0 for name in form if self._dtypes[name] is np.str_}

    def __len__(self) -> int:
        return len(self._header[0])

    @property
    def characters(self) -> int:
        """Room for the longest text in every row."""
        return max(self._longest.values(), default=0) * len(self)

    def add(self, entry: LogMessage) -> None:
        times_ns = (entry.log_time_ns, entry.publish_time_ns, entry.sequence)
        for column, value in zip(self._header, times_ns, strict=True):
            column.append(value)
        for name, column in self._fields:
            column.append(getattr(entry.message, name))
        for name, longest in self._longest.items():
            self._longest[name] = max(longest, len(self._values[name][-1]))

    def columns(self, what: str) -> Columns:
        """Its columns; an array of texts has room for the longest one in every row."""
        for name, longest in self._longest.items():
            if longest * len(self) > _MOST_CHARACTERS:
                msg = (
                    f"{what}: a {name} has {longest} characters; expected texts as fitctl records them; "
                    "choose other topics, or cut that time out with `fitctl log cut`"
                )
                raise LogError(msg)
        return {
            name: np.array(values, dtype=self._dtypes[name])
            for name, values in self._values.items()
        }


def log_info(path: Path) -> LogInfo:
    """Describe a log: from its index, or from reading it through if it has none.

    Parameters
    ----------
    path : Path
        An MCAP log.

    Returns
    -------
    LogInfo

    Raises
    ------
    LogError
        If the file is missing, no MCAP log, or finished and yet damaged.

    Examples
    --------
    >>> log_info(Path("night.mcap")).counts["/fit/right/tick"] > 1000
    True
    """
    with opened(path) as (stream, finished):
        counts: Counter[str] = Counter()
        described: list[Metadata] = []
        span_ns: list[int] = []  # of the first message, of the last
        with up_to_the_tear(path, finished):
            if finished:
                span_ns = _read_index(SeekingReader(stream), counts, described)
            else:
                _scan(path, stream, counts, described, span_ns)
    return LogInfo(
        path=path,
        finished=finished,
        start_s=span_ns[0] / 1e9 if span_ns else math.nan,
        end_s=span_ns[-1] / 1e9 if span_ns else math.nan,
        counts=dict(counts),
        metadata={entry.name: entry.metadata for entry in described},
        runs=len({tuple(entry.metadata.items()) for entry in described if entry.name == "clock"}),
    )


class LogClock(NamedTuple):
    """The clocks of a run, seconds: how its wall clock and its monotonic clock differ, and when it began."""

    wall_minus_monotonic_s: float
    run_start_monotonic_s: float


def clock_of(path: Path, metadata: Mapping[str, Mapping[str, str]]) -> LogClock:
    """The clocks that a log's metadata has.

    Raises
    ------
    LogError
        If it has none, or no usable numbers.
    """
    clock = metadata.get("clock", {})
    try:
        found = LogClock(*(float(clock[name]) for name in LogClock._fields))
    except (KeyError, ValueError):
        found = LogClock(math.nan, math.nan)
    if not all(abs(value) < MOST for value in found):
        msg = f"{path}: has no start of its run (metadata clock); name a log that fitctl recorded"
        raise LogError(msg)
    return found


def own_times_s(log: LogInfo, start_s: float, end_s: float) -> tuple[float, float]:
    """Between which times records can be by their own time, seconds since 1970.

    Their own times are by the clock as it was when the run began, the log's by the clock as it was when they
    were recorded: someone may have set it meanwhile. Of a log without the run's clock nothing is known.

    Parameters
    ----------
    log : LogInfo
        Of the run.
    start_s, end_s : float
        The log times of the first and the last record.
    """
    try:
        began_s = sum(clock_of(log.path, log.metadata))
    except LogError:
        return -math.inf, math.inf
    last_s = max(end_s, began_s + end_s - start_s)
    return min(start_s, began_s) - _CLOCK_SET_S, last_s + _CLOCK_SET_S


def logs_of_one_run_each(paths: Sequence[Path]) -> list[LogInfo]:
    """Describe logs as :func:`log_info` does, where each has to be of one run.

    Raises
    ------
    LogError
        If one cannot be read, or is of several runs.
    """
    logs = [log_info(path) for path in paths]
    for log in logs:
        if log.runs > 1:
            msg = (
                f"{log.path}: holds {log.runs} runs, as after `fitctl log merge`; expected one: name the log "
                "of one run"
            )
            raise LogError(msg)
    return logs


def _read_index(
    reader: SeekingReader, counts: Counter[str], described: list[Metadata]
) -> list[int]:
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        msg = "its index has no statistics"
        raise McapError(msg)
    statistics = summary.statistics
    for channel, number in statistics.channel_message_counts.items():
        counts[summary.channels[channel].topic] += number
    if statistics.message_count != counts.total():
        msg = (
            f"its index counts {statistics.message_count} messages, and {counts.total()} by channel"
        )
        raise McapError(msg)
    described += reader.iter_metadata()
    if not statistics.message_count:
        return []
    return [statistics.message_start_time, statistics.message_end_time]


def _scan(
    path: Path,
    stream: IO[bytes],
    counts: Counter[str],
    described: list[Metadata],
    span_ns: list[int],
) -> None:
    channels: Described[Channel] = Described(path)
    for entry in StreamReader(stream, validate_crcs=True).records:
        if isinstance(entry, Channel):
            channels[entry.id] = entry
        elif isinstance(entry, Metadata):
            described.append(entry)
        elif isinstance(entry, Message):
            counts[channels[entry.channel_id].topic] += 1
            span_ns[1:] = [entry.log_time]  # the first one stays
