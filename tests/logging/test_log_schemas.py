import io
import math

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor_pool import DescriptorPool
from hypothesis import given
from hypothesis import strategies as st
from samples.log_samples import RUN_INFO, filled, one_of_each
from samples.logged_simulation import designs_of

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.daemon.run import run_info
from fitctl.logging.records import AnyRecord, Event, FrameRecord, RunInfo, Tick
from fitctl.logging.schemas import (
    TOPICS,
    dark_npy_of,
    message_class,
    run_metadata,
    to_message,
    topic_of,
)

WALL_NS = 1_795_000_000_250_000_001


def test_every_record_but_the_run_info_has_a_topic():
    assert set(TOPICS) == set(AnyRecord.__args__) - {RunInfo}


OURS = [record for record in one_of_each() if not isinstance(record, FrameRecord | Event)]


@pytest.mark.parametrize("record", OURS, ids=lambda record: type(record).__name__)
def test_a_message_has_every_field_of_its_record(record):
    message = to_message(record, WALL_NS)
    values = {field.name: getattr(message, field.name) for field in message.DESCRIPTOR.fields}
    np.testing.assert_equal(values, msgspec.structs.asdict(record))
    assert message.DESCRIPTOR.full_name == f"fitctl.{type(record).__name__}"


def test_topics_carry_the_loop():
    assert [topic_of(record) for record in one_of_each()] == [
        "/fit/right/tick",
        "/fit/camera/frame",
        "/fit/right/mode",
        "/fit/events",
        "/fit/right/timing",
        "/fit/right/piezo",
        "/fit/devices/health",
        "/fit/recorder/status",
    ]


def test_what_a_tick_lacks_is_not_a_number():
    given = [
        field for field in msgspec.structs.fields(Tick) if field.default is not msgspec.NODEFAULT
    ]
    floats = {field.name: field.default for field in given if field.type is float}
    assert "link_az_rad" in floats
    assert all(math.isnan(default) for default in floats.values()), floats


def test_a_frame_is_a_16_bit_image_that_viewers_know():
    pixels = np.arange(6, dtype="<u2").reshape(2, 3) * 1000
    frame = filled(FrameRecord, camera="cam", width_px=3, height_px=2, data=pixels.tobytes())
    image = to_message(frame, WALL_NS)
    assert image.DESCRIPTOR.full_name == "foxglove.RawImage"
    assert (image.encoding, image.width, image.height, image.step) == ("mono16", 3, 2, 6)
    assert image.timestamp.ToNanoseconds() == WALL_NS
    np.testing.assert_array_equal(np.frombuffer(image.data, "<u2").reshape(2, 3), pixels)


@pytest.mark.parametrize(
    ("severity", "level"), [("info", Log.INFO), ("warning", Log.WARNING), ("error", Log.ERROR)]
)
def test_an_event_is_a_log_line_that_viewers_know(severity, level):
    event = Event(time_s=1.0, severity=severity, source="camera", message="no frames")
    line = to_message(event, WALL_NS)
    assert line.DESCRIPTOR.full_name == "foxglove.Log"
    assert (line.level, line.name, line.message) == (level, "camera", "no frames")


ANY_VALUE = {
    float: st.floats(width=64),
    int: st.integers(-(2**63), 2**63 - 1),
    bool: st.booleans(),
    str: st.text(),
}


@given(st.builds(Tick, **{f.name: ANY_VALUE[f.type] for f in msgspec.structs.fields(Tick)}))
@pytest.mark.long
def test_a_tick_survives_the_wire_bit_by_bit(tick):
    message = to_message(tick, WALL_NS)
    back = type(message).FromString(message.SerializeToString())
    values = {field.name: getattr(back, field.name) for field in back.DESCRIPTOR.fields}
    np.testing.assert_equal(values, msgspec.structs.asdict(tick))


def test_none_is_told_from_zero():
    class Sometimes(msgspec.Struct):
        seed: int | None

    kind = message_class(Sometimes, DescriptorPool())
    assert not kind.FromString(kind(seed=None).SerializeToString()).HasField("seed")
    assert kind.FromString(kind(seed=0).SerializeToString()).HasField("seed")


def test_a_field_that_protobuf_cannot_hold_is_named():
    class Bad(msgspec.Struct):
        things: dict[str, str]

    with pytest.raises(TypeError, match=r"Bad\.things"):
        message_class(Bad, DescriptorPool())


def test_the_run_is_described_in_metadata_without_rounding():
    metadata = run_metadata(RUN_INFO)
    assert metadata["rig"] == {"name": "bench", "json": '{"name": "bench"}'}
    assert metadata["random_seed"] == {"value": "7"}
    assert metadata["designs"] == {"right": '{"name": "eq20"}'}
    assert dark_npy_of(metadata) == RUN_INFO.dark_npy
    assert float(metadata["clock"]["wall_minus_monotonic_s"]) == RUN_INFO.wall_minus_monotonic_s


def test_a_dark_frame_in_a_log_is_as_its_file_was_or_refused_where_it_is_damaged():
    file = io.BytesIO()
    np.save(file, np.random.default_rng(1).normal(1000.0, 20.0, (40, 40)).astype(np.float32))
    info = msgspec.structs.replace(RUN_INFO, dark_npy=file.getvalue())
    (text,) = run_metadata(info)["dark"].values()

    assert dark_npy_of(run_metadata(info)) == file.getvalue()
    assert len(text) < 1.25 * len(file.getvalue())  # as text, and yet not a third larger
    assert dark_npy_of({}) is None
    assert dark_npy_of(run_metadata(msgspec.structs.replace(info, dark_npy=None))) is None
    for damaged in (text[:-8], "AAAA", "no text", text.replace("A", "B")):
        with pytest.raises(ValueError, match="metadata dark: is no compressed dark frame"):
            dark_npy_of({"dark": {"npy_zlib_base64": damaged}})


def test_the_design_that_a_log_carries_can_be_used_again(tmp_path):
    rig = load_rig(default_rig_path())
    metadata = run_metadata(run_info(rig, "", now_s=0.0, designs=designs_of(rig)))
    path = tmp_path / "of-the-log.json"
    path.write_text(metadata["designs"]["right"])
    again, first = design_for(rig, "right", str(path)), design_for(rig, "right")
    assert again.name == first.name
    np.testing.assert_array_equal(again.a, first.a)
