"""The judges of the catalogue can say no."""

from types import SimpleNamespace

import pytest
from stalls import Stalls

from .engine import check_still, stood_still, ticks_went_on
from .entries.entry import Entry
from .watched import Place

ENTRY = Entry("right.drive", "drop", ("SAFE",))
BIAS = [5.0, 5.0, 5.0]
OFF_BIAS = [5.6, 5.0, 4.4]


def place(time_s, motor_rad=0.0, stack_v=BIAS):
    return Place(time_s, [motor_rad, 0.0], stack_v)


def rig(*places, changes=(), numbers=(), skipped=0):
    """A rig as far as judges look at it."""
    message = SimpleNamespace(
        mode_changes=[SimpleNamespace(time_s=t, target=mode, loop="right") for t, mode in changes],
        ticks=[
            SimpleNamespace(number=number, frames_skipped=skipped * (number == max(numbers)))
            for number in numbers
        ],
        timing=[],
    )
    return SimpleNamespace(places=list(places), telemetry=[message])


def test_standing_still_and_a_mirror_on_its_way_to_its_bias_are_well():
    check_still([place(0.0, 1.0, OFF_BIAS), place(1.0, 1.001, [5.2, 5.0, 4.9]), place(2.0, 1.0)])


@pytest.mark.parametrize(
    "then",
    [
        pytest.param(place(1.0, motor_rad=0.1), id="a motor creeps"),
        pytest.param(place(1.0, stack_v=[5.5, 5.0, 5.0]), id="the mirror leaves its bias"),
    ],
)
def test_what_moves_at_rest_is_noticed(then):
    with pytest.raises(AssertionError):
        check_still([place(0.0), then])


def test_only_modes_of_rest_are_judged():
    moving = [place(1.0 + 0.1 * n, motor_rad=float(n)) for n in range(10)]
    tracking = rig(*moving, place(5.0, 9.0), changes=[(3.0, "SAFE")])
    stood_still(tracking, ENTRY, struck_s=0.0, deaf=False)
    with pytest.raises(AssertionError):
        stood_still(rig(*moving, changes=[(0.5, "SAFE")]), ENTRY, struck_s=0.0, deaf=False)


def test_frames_without_a_tick_are_excused_by_a_stall_or_counted_as_skipped():
    stalled = Stalls()
    gap = rig(numbers=[1, 2, 3, 10, 11])
    with pytest.raises(AssertionError, match="6 frames without a tick"):
        ticks_went_on(gap, stalled)
    ticks_went_on(rig(numbers=[1, 2, 3, 10, 11], skipped=6), stalled)
    stalled.total_s = 0.12
    ticks_went_on(gap, stalled)
