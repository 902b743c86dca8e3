"""Where each record goes in a log, and as which protobuf message.

The messages are built at import from the structs of :mod:`fitctl.logging.records`, so a field is
defined once. Frames and events take Foxglove's own messages, which viewers know how to show.
"""

from __future__ import annotations

import base64
import contextlib
import json
import types
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Literal, Union, get_args, get_origin

import msgspec
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp

from fitctl.logging.records import (
    AnyRecord,
    BeamPlace,
    CommandRecord,
    ControllerChange,
    DeviceFailure,
    DeviceHealth,
    DevicesOpened,
    Event,
    ExperimentStart,
    FrameRecord,
    InjectionRecord,
    LoopTiming,
    Losses,
    MetrologyTick,
    ModeChange,
    OutputsFound,
    Overlap,
    PiezoReading,
    QuantityReading,
    RecorderStatus,
    RunInfo,
    SequenceAttempt,
    Snapshot,
    StarPlace,
    Tick,
)

TOPICS: dict[type[AnyRecord], str] = {
    Tick: "/fit/{loop}/tick",
    MetrologyTick: "/fit/{loop}/metrology",
    Overlap: "/fit/{loop}/overlap",
    FrameRecord: "/fit/camera/frame",
    ModeChange: "/fit/{loop}/mode",
    ControllerChange: "/fit/{loop}/controller",
    DevicesOpened: "/fit/{loop}/opened",
    OutputsFound: "/fit/{loop}/outputs_found",
    StarPlace: "/fit/{loop}/star_place",
    BeamPlace: "/fit/{loop}/beam_place",
    DeviceFailure: "/fit/{loop}/failure",
    QuantityReading: "/fit/quantities",
    ExperimentStart: "/fit/{loop}/experiment",
    InjectionRecord: "/fit/{loop}/injection",
    Event: "/fit/events",
    LoopTiming: "/fit/{loop}/timing",
    PiezoReading: "/fit/{loop}/piezo",
    DeviceHealth: "/fit/devices/health",
    RecorderStatus: "/fit/recorder/status",
    Losses: "/fit/losses",
    SequenceAttempt: "/fit/sequence/attempts",
    CommandRecord: "/fit/commands",
    Snapshot: "/fit/snapshots",
}
"""RunInfo is missing because it is kept as metadata: see :func:`run_metadata`."""

_FIELD_TYPES = {
    float: FieldDescriptorProto.TYPE_DOUBLE,
    int: FieldDescriptorProto.TYPE_INT64,
    bool: FieldDescriptorProto.TYPE_BOOL,
    str: FieldDescriptorProto.TYPE_STRING,
    bytes: FieldDescriptorProto.TYPE_BYTES,
}
_LEVELS = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_BYTES_PER_PIXEL = 2
MOST_DARK_BYTES = 64 << 20  # of a dark frame's file: eight million pixels as float64
_DARK = "npy_zlib_base64"  # metadata holds text only; all that copies a log copies it


def topic_of(record: AnyRecord) -> str:
    """The topic of a record; ``{loop}`` stands for the record's own loop."""
    return TOPICS[type(record)].format(loop=getattr(record, "loop", ""))


def to_message(record: AnyRecord, wall_ns: int) -> Message:
    """The protobuf message of a record.

    Parameters
    ----------
    record : AnyRecord
        Anything but a RunInfo.
    wall_ns : int
        The record's own time as nanoseconds since 1970; Foxglove's messages carry it.
    """
    convert = _FOXGLOVE.get(type(record))
    if convert is not None:
        return convert(record, wall_ns)
    return MESSAGES[type(record)](**msgspec.structs.asdict(record))


def fields_of(kind: type[AnyRecord], message: Message) -> dict[str, Any]:
    """What a message has of the fields of a record; one of an older version lacks some."""
    there = message.DESCRIPTOR.fields_by_name
    return {name: getattr(message, name) for name in kind.__struct_fields__ if name in there}


def run_metadata(info: RunInfo) -> dict[str, dict[str, str]]:
    """A run's description as MCAP metadata: name to texts. Floats read back exactly."""
    metadata = {
        "rig": {"name": info.rig_name, "json": info.rig_json},
        "versions": dict(info.versions),
        "scheduling": {"policy": info.scheduling},
        "clock": {
            "wall_minus_monotonic_s": repr(info.wall_minus_monotonic_s),
            "run_start_monotonic_s": repr(info.time_s),
        },
    }
    if info.designs:
        metadata["designs"] = dict(info.designs)
    if info.random_seed is not None:
        metadata["random_seed"] = {"value": str(info.random_seed)}
    if info.dark_npy is not None:
        metadata["dark"] = {_DARK: base64.b64encode(zlib.compress(info.dark_npy)).decode()}
    return metadata


def dark_npy_of(metadata: Mapping[str, Mapping[str, str]]) -> bytes | None:
    """The dark frame's file (.npy) that :func:`run_metadata` put there; None where there is none.

    Raises
    ------
    ValueError
        If it is damaged.
    """
    text = metadata.get("dark", {}).get(_DARK)
    if text is None:
        return None
    try:
        unpacking = zlib.decompressobj()
        npy = unpacking.decompress(base64.b64decode(text, validate=True), MOST_DARK_BYTES)
        if not unpacking.eof:
            msg = f"it is cut off, or has more than {MOST_DARK_BYTES >> 20} MiB"
            raise ValueError(msg)
        return npy
    except (ValueError, zlib.error) as error:
        msg = f"metadata dark: is no compressed dark frame: {error}"
        raise ValueError(msg) from None


def designs_of(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Any]]:
    """The design that each loop began with, by loop; those are left out that are no JSON object.

    Anyone may have written the log: neither the loops' names nor what a design has in it need make sense.
    """
    found = {}
    for loop, text in metadata.get("designs", {}).items():
        with contextlib.suppress(ValueError, RecursionError):
            document = json.loads(text)
            if isinstance(document, dict):
                found[loop] = document
    return found


def message_class(record_type: type[msgspec.Struct], pool: DescriptorPool) -> type[Message]:
    """Build the protobuf message ``fitctl.<name>`` of a struct, field by field, into `pool`.

    A field that may be None becomes optional, so that None differs from zero.

    Raises
    ------
    TypeError
        If a field has no protobuf counterpart here.
    """
    file = FileDescriptorProto(
        name=f"fitctl/{record_type.__name__}.proto", package="fitctl", syntax="proto3"
    )
    message = file.message_type.add(name=record_type.__name__)
    for number, struct_field in enumerate(msgspec.structs.fields(record_type), start=1):
        python_type, optional = _plain_type(struct_field.type)
        if python_type not in _FIELD_TYPES:
            msg = f"{record_type.__name__}.{struct_field.name}: {struct_field.type} has no protobuf type"
            raise TypeError(msg)
        field = message.field.add(
            name=struct_field.name,
            number=number,
            type=_FIELD_TYPES[python_type],
            label=FieldDescriptorProto.LABEL_OPTIONAL,
        )
        if optional:  # proto3 wants a one-member "oneof" beside each optional field
            field.proto3_optional = True
            field.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{struct_field.name}")
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(f"fitctl.{record_type.__name__}"))


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    """``X`` and whether None is allowed, of ``X | None``; a Literal is the type of its values."""
    optional = False
    if get_origin(annotation) in {Union, types.UnionType}:
        options = [option for option in get_args(annotation) if option is not types.NoneType]
        optional = len(options) < len(get_args(annotation))
        annotation = options[0] if len(options) == 1 else annotation
    if get_origin(annotation) is Literal:
        annotation = type(get_args(annotation)[0])
    return annotation, optional


def _timestamp(wall_ns: int) -> Timestamp:
    return Timestamp(seconds=wall_ns // 1_000_000_000, nanos=wall_ns % 1_000_000_000)


def _raw_image(frame: FrameRecord, wall_ns: int) -> RawImage:
    return RawImage(
        timestamp=_timestamp(wall_ns),
        frame_id=frame.camera,
        width=frame.width_px,
        height=frame.height_px,
        encoding="mono16",
        step=frame.width_px * _BYTES_PER_PIXEL,
        data=frame.data,
    )


def _log(event: Event, wall_ns: int) -> Log:
    return Log(
        timestamp=_timestamp(wall_ns),
        level=_LEVELS[event.severity],
        message=event.message,
        name=event.source,
    )


_FOXGLOVE: dict[type[AnyRecord], Callable[[Any, int], Message]] = {
    FrameRecord: _raw_image,
    Event: _log,
}
_POOL = DescriptorPool()
MESSAGES: dict[type[AnyRecord], type[Message]] = {
    FrameRecord: RawImage,
    Event: Log,
    **{kind: message_class(kind, _POOL) for kind in TOPICS if kind not in _FOXGLOVE},
}
"""The protobuf message that each kind of record becomes."""
