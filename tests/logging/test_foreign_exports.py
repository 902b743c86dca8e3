"""What fitctl did not record as it is today is exported rightly, or refused in one line."""

from base64 import b64decode
from csv import DictReader

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pool import DescriptorPool
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.writer import Writer
from samples.log_samples import RUN_INFO, filled, tick, write_log

from fitctl.logging.copying import merge
from fitctl.logging.errors import LogError
from fitctl.logging.exporting import export
from fitctl.logging.reading import column_blocks
from fitctl.logging.records import ExperimentStart, Tick
from fitctl.logging.schemas import TOPICS, message_class

TICKS, FRAMES, EVENTS = "/fit/right/tick", "/fit/camera/frame", "/fit/events"


def message_of(fields, name="Tick"):
    return message_class(msgspec.defstruct(name, fields.items()), DescriptorPool())()


def written(path, topic, message, time_ns=10**18):
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message(topic, message, time_ns, time_ns)
    return path


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
@pytest.mark.parametrize("old_first", [True, False])
def test_a_log_merged_from_two_versions_is_not_exported(tmp_path, kind, old_first):
    new = {one.name: one.type for one in msgspec.structs.fields(Tick)}
    old = {name: of_type for name, of_type in new.items() if name != "fsm_az_rad"}
    shapes = [old, new] if old_first else [new, old]
    logs = [
        written(tmp_path / f"{n}.mcap", TICKS, message_of(shape), 10**18 + n)
        for n, shape in enumerate(shapes)
    ]
    merge(logs, tmp_path / "both.mcap")

    with pytest.raises(LogError, match=r"both\.mcap: /fit/right/tick has two forms.*by itself$"):
        export(tmp_path / "both.mcap", tmp_path / "out", kind, [TICKS])
    assert not (tmp_path / "out").exists()


def test_a_column_that_both_versions_have_is_read_from_a_merged_log(tmp_path):
    shapes = [{"number": int}, {"number": int, "held": bool}]
    logs = [
        written(tmp_path / f"{n}.mcap", TICKS, message_of(shape), 10**18 + n)
        for n, shape in enumerate(shapes)
    ]
    merge(logs, tmp_path / "both.mcap")

    (block,) = column_blocks(tmp_path / "both.mcap", fields={TICKS: ["number"]})
    assert block[1]["number"].tolist() == [0, 0]


def test_a_time_that_goes_into_no_column_is_refused(tmp_path):
    path = write_log(tmp_path / "late.mcap", [tick(1)], start_s=9.3e9)

    with pytest.raises(LogError, match=r"late\.mcap: /fit/right/tick is not as fitctl records it"):
        list(column_blocks(path))


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        (FRAMES, message_of({"number": int})),
        (FRAMES, RawImage(width=3, height=2, data=b"odd")),
        (FRAMES, message_of({"data": bytes, "encoding": str, "step": int})),
        (EVENTS, message_of({"number": int})),
        (EVENTS, Log(level=77)),
    ],
)
def test_foreign_content_is_refused_in_one_line(tmp_path, topic, message):
    path = written(tmp_path / "a.mcap", topic, message)

    with pytest.raises(LogError, match=r"is not as fitctl records it: .*fitctl recorded$"):
        export(path, tmp_path / "out", "npz", [topic])
    assert not (tmp_path / "out").exists()


def test_a_column_whose_name_npz_does_not_allow_is_refused(tmp_path):
    path = written(tmp_path / "a.mcap", "/other", message_of({"file": str}))

    with pytest.raises(
        LogError, match="npz cannot hold a column named file; export csv or parquet"
    ):
        export(path, tmp_path / "out", "npz", ["/other"])


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_two_topics_that_would_become_one_file_are_refused(tmp_path, kind):
    log = tmp_path / "twins.mcap"
    with log.open("wb") as stream, Writer(stream) as writer:
        for number, topic in enumerate((TICKS, "/fit.right.tick")):
            message = message_of({"number": int}, f"Tick{number}")
            writer.write_message(topic, message, 10**18, 10**18)

    with pytest.raises(LogError, match=r"and another topic both become fit\.right\.tick"):
        export(log, tmp_path / "out", kind, [TICKS, "/fit.right.tick"])
    assert not (tmp_path / "out").exists()


def test_a_name_keeps_its_name(tmp_path):
    """Only that of an event is its source, as everywhere in fitctl."""
    experiment = filled(ExperimentStart, name="rest")
    log = write_log(tmp_path / "a.mcap", [RUN_INFO, experiment])

    export(log, tmp_path / "npz", "npz", [TOPICS[ExperimentStart].format(loop="right")])

    columns = np.load(tmp_path / "npz" / "fit.right.experiment.npz")
    assert columns["name"].tolist() == ["rest"]


def test_bytes_are_exported_so_that_they_can_be_read_back_without_pickle(tmp_path):
    log, topic, states = tmp_path / "states.mcap", "/fit/snapshots", [b"\x00ab", b"", b"\xff"]
    with log.open("wb") as stream, Writer(stream) as writer:
        for number, state in enumerate(states):
            message = message_of({"state_msgpack": bytes}, "State")
            message.state_msgpack = state
            writer.write_message(topic, message, 10**18 + number, 10**18 + number)

    export(log, tmp_path / "npz", "npz", [topic])
    export(log, tmp_path / "csv", "csv", [topic])

    with np.load(tmp_path / "npz" / "fit.snapshots.npz", allow_pickle=False) as file:
        ends = np.cumsum(file["state_msgpack_lengths"])[:-1]
        parts = np.split(file["state_msgpack"], ends)
    assert [part.tobytes() for part in parts] == states
    with (tmp_path / "csv" / "fit.snapshots.csv").open() as stream:
        assert [b64decode(row["state_msgpack"]) for row in DictReader(stream)] == states


def test_a_text_that_would_need_gigabytes_in_every_row_is_refused(tmp_path):
    log = tmp_path / "long.mcap"
    with log.open("wb") as stream, Writer(stream) as writer:
        for number in range(1000):
            message = message_of({"message": str}, "Text")
            message.message = "x" * (1_000_000 if number == 5 else 3)
            writer.write_message(EVENTS, message, 10**18 + number, 10**18 + number)

    with pytest.raises(LogError, match=r"/fit/events: a message has 1000000 characters"):
        list(column_blocks(log))


def test_a_topic_in_another_format_is_not_called_damage(tmp_path):
    log = tmp_path / "json.mcap"
    with log.open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start()
        channel = writer.register_channel("/odo", "json", schema_id=0)
        writer.add_message(channel, log_time=10**18, data=b"{}", publish_time=10**18)
        writer.finish()

    with pytest.raises(LogError, match=r"another format .*leave them out with --topic"):
        list(column_blocks(log))
