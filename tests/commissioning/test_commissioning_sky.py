"""Motors that are sent somewhere with the star watched: they get there, or the step stops."""

import numpy as np
import pytest
from commissioning.motor_bench import RIG, BenchAmplifiers, site_of

from fitctl.clock import VirtualClock
from fitctl.commissioning.motors import Motors
from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.sky import Watch, displaced


def watch_of(**wiring):
    clock = VirtualClock()
    bench = BenchAmplifiers(clock, **wiring)
    bench.enable()
    return bench, Watch(site_of(RIG, clock), None, Motors(bench, 0.002, clock))


def test_motors_get_where_they_are_sent():
    bench, watch = watch_of()
    watch.turn_to(np.array([1.0, -0.5]))
    assert bench.motor_rad == pytest.approx([1.0, -0.5], abs=0.02)
    assert bench.furthest_rad < 1.02


@pytest.mark.parametrize(
    ("wiring", "named"),
    [
        ({"gains": ((-1, 0), (0, 1))}, "goes away"),
        ({"gains": ((0, 0), (0, 1))}, "does not follow"),
    ],
)
def test_a_motor_that_does_not_is_stopped(wiring, named):
    bench, watch = watch_of(**wiring)
    with pytest.raises(StepError, match=named):
        watch.turn_to(np.array([1.0, 0.0]))
    assert bench.furthest_rad < 0.3


def test_no_motor_is_sent_beyond_the_travel():
    bench, watch = watch_of()
    with pytest.raises(StepError, match="beyond the travel"):
        watch.turn_to(np.array([0.0, 1.01 * RIG.loops["right"].siderostat.travel_rad]))
    assert bench.furthest_rad == 0.0


STILL, OTHER = np.array([28.0, 20.0]), np.array([12.0, 20.0])


@pytest.mark.parametrize("by_px", [(2.4, 0.0), (-9.0, 9.0)])
def test_the_one_star_that_has_moved_is_found_among_others(by_px):
    was, now = displaced([STILL, OTHER], [OTHER + by_px, 0.1 + STILL])
    assert was == pytest.approx(OTHER)
    assert now == pytest.approx(OTHER + by_px)


@pytest.mark.parametrize(
    ("before", "after"),
    [([STILL, OTHER], [STILL, OTHER]), ([STILL, OTHER], [STILL]), ([STILL], [STILL, OTHER])],
)
def test_stars_that_stand_still_come_or_go_have_not_moved(before, after):
    assert displaced(before, after) is None
