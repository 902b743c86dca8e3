"""What is an experiment among the records of a log."""

import math
import typing

import msgspec
import numpy as np
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from mcap_protobuf.writer import Writer

from fitctl.identify.errors import IdentifyError
from fitctl.identify.link.step_record import gather_step_log
from fitctl.identify.record import gather, gather_log
from fitctl.logging.records import ExperimentStart, InjectionRecord, SequenceAttempt, Tick
from fitctl.logging.schemas import message_class, topic_of


def ticks(*times_s):
    hints = typing.get_type_hints(Tick)
    values = {name: hints[name]() for name in (one.name for one in msgspec.structs.fields(Tick))}
    known = {"loop": "right", "mode": "EXPERIMENT"}
    return [Tick(**values | known | {"time_s": at_s}) for at_s in times_s]


def injected(*rows):
    return [
        InjectionRecord(time_s=at_s, loop="right", stack1_v=volts, stack2_v=0.0, stack3_v=0.0)
        for at_s, volts in rows
    ]


START = ExperimentStart(time_s=0.0, loop="right", name="delay", drives_json="[]")


def test_the_last_experiment_of_a_name_is_gathered():
    first = [START, *injected((0.0, 1.0)), *ticks(0.1)]
    last = [START, *injected((5.0, 2.0), (6.0, 3.0)), *ticks(5.1, 5.2)]
    record = gather([*first, *last], "right", "delay")

    assert record.injected_s.tolist() == [5.0, 6.0]
    assert record.injected_v[:, 0].tolist() == [2.0, 3.0]
    assert record.tick["time_s"].tolist() == [5.1, 5.2]


@pytest.mark.parametrize(
    ("rows", "times_s"),
    [
        ([(math.nan, 1.0)], [0.1]),
        ([(0.0, math.inf)], [0.1]),
        ([(2.0, 1.0), (1.0, 1.0)], [0.1]),
        ([(0.0, 1.0)], [math.nan]),
        ([(0.0, 1.0)], [0.2, 0.1]),
    ],
)
def test_times_and_voltages_that_cannot_be_are_refused(rows, times_s):
    with pytest.raises(IdentifyError, match="not finite, or times that go back"):
        gather([START, *injected(*rows), *ticks(*times_s)], "right", "delay")


def test_a_frame_s_time_that_is_not_a_number_is_refused():
    (tick,) = ticks(0.1)
    untimed = msgspec.structs.replace(tick, mid_exposure_s=math.nan)

    with pytest.raises(IdentifyError, match="not finite, or times that go back"):
        gather([START, *injected((0.0, 1.0)), untimed], "right", "delay")


# ---------------------------------------------------------------- logs of other versions


def log_of(path, records, **types):
    """A log whose records have some fields of another type, or lack them: None."""
    classes = {}
    with path.open("wb") as stream, Writer(stream) as writer:
        for number, record in enumerate(records):
            kind = type(record)
            if kind not in classes:
                shape = {one.name: one.type for one in msgspec.structs.fields(kind)} | types
                fields = [(name, shape[name]) for name in kind.__struct_fields__ if shape[name]]
                struct = msgspec.defstruct(kind.__name__, fields)
                classes[kind] = (
                    message_class(struct, DescriptorPool()),
                    [name for name, _ in fields],
                )
            message, names = classes[kind]
            values = {
                name: types.get(name, lambda value: value)(getattr(record, name)) for name in names
            }
            writer.write_message(topic_of(record), message(**values), number, number)
    return path


LATER = {"sky_az_rad": None, "sky_el_rad": None, "held": None}  # than 0.2.0
EXPERIMENT = [START, *injected((0.0, 1.0)), *ticks(0.1, 0.2)]


def test_a_log_of_an_earlier_version_has_the_defaults_of_what_it_lacks(tmp_path):
    record = gather_log(log_of(tmp_path / "old.mcap", EXPERIMENT, **LATER), "right", "delay")

    assert record.tick["time_s"].tolist() == [0.1, 0.2]
    assert np.isnan(record.tick["sky_az_rad"]).tolist() == [True, True]
    assert record.tick["held"].tolist() == [False, False]


def test_a_step_in_a_log_of_an_earlier_version_has_the_defaults_of_what_it_lacks(tmp_path):
    attempt = SequenceAttempt(
        time_s=1.0, sequence_name="s", step_number=1, step="collector_scan", loop="right", attempt=1,
        began_s=0.0, ended_s=1.0, outcome="done", message="", figures_json="{}",
    )  # fmt: skip
    path = log_of(tmp_path / "old.mcap", [*ticks(0.1, 0.2), attempt], **LATER)

    found = gather_step_log(path, Tick, "right", "collector_scan")
    assert found["time_s"].tolist() == [0.1, 0.2]
    assert found["held"].tolist() == [False, False]


@pytest.mark.parametrize(
    ("types", "why"),
    [
        ({"star_az_px": None}, "required field `star_az_px`"),
        ({"late": int}, r"Expected `bool`, got `int` - at `\$\.late`"),
    ],
)
def test_a_log_without_what_has_no_default_is_refused(tmp_path, types, why):
    path = log_of(tmp_path / "odd.mcap", EXPERIMENT, **types)

    with pytest.raises(IdentifyError, match=rf"a record of /fit/right/tick is not.*{why}"):
        gather_log(path, "right", "delay")
