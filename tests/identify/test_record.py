"""What is an experiment among the records of a log."""

import math
import typing

import msgspec
import pytest

from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import gather
from fitctl.logging.records import ExperimentStart, InjectionRecord, Tick


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
