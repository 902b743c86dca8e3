"""What fitctl did not record as it is today is exported rightly, or refused in one line."""

import msgspec
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pool import DescriptorPool
from mcap_protobuf.writer import Writer
from samples.log_samples import tick, write_log

from fitctl.logging.copying import merge
from fitctl.logging.errors import LogError
from fitctl.logging.exporting import export
from fitctl.logging.reading import column_blocks
from fitctl.logging.records import Tick
from fitctl.logging.schemas import message_class

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
    assert list((tmp_path / "out").iterdir()) == []


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
    assert list((tmp_path / "out").iterdir()) == []


def test_a_column_whose_name_npz_does_not_allow_is_refused(tmp_path):
    path = written(tmp_path / "a.mcap", "/other", message_of({"file": str}))

    with pytest.raises(
        LogError, match="npz cannot hold a column named file; export csv or parquet"
    ):
        export(path, tmp_path / "out", "npz", ["/other"])
