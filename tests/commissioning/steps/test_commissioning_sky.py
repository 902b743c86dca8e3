"""Motors that are sent somewhere with the star watched: they get there, or the step stops."""

import numpy as np
import pytest
from commissioning.motor_bench import RIG, BenchAmplifiers, site_of

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps.motors import Motors
from fitctl.commissioning.steps.plate import star_moves
from fitctl.commissioning.steps.sky import Watch, displaced, search
from fitctl.controllers.centroid import Star
from fitctl.model.optics import scales


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
        ({"gains": ((-1, 0), (0, 1))}, "moves away"),
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


LOOP = RIG.loops["right"]
FRINGE = LOOP.other_spots[0]
PX_PER_RAD = scales(RIG, LOOP).motor_px_per_rad


class Sky(Watch):
    """A star with the other spot of the rig file beside it, moved by motors that are mounted the other way."""

    def __init__(self, star_px, part=1.0):
        clock = VirtualClock()
        self.bench = BenchAmplifiers(clock)
        self.bench.enable()
        super().__init__(site_of(RIG, clock), None, Motors(self.bench, 0.002, clock))
        self.star_px, self.part = np.array(star_px), part

    def _spots(self, count):
        az, el = self.bench.motor_rad
        star_px = self.star_px + PX_PER_RAD * np.array([el, -az])
        offset_px = np.array([FRINGE.offset_px.az, FRINGE.offset_px.el])
        both = ((star_px, LOOP.star_flux_dn), (star_px + offset_px, FRINGE.flux_dn))
        seen = [Star(*at, self.part * light, 0, 0) for at, light in both if self._is_on_frame(at)]
        return [seen] * count

    def _is_on_frame(self, at_px):
        return bool(
            np.all(at_px >= 0) and np.all(at_px < (RIG.camera.width_px, RIG.camera.height_px))
        )


BEYOND_PX = RIG.camera.width_px + 2.0  # its other spot is on the frame


@pytest.mark.parametrize("el_px", [5.0, 20.0, 34.0])
def test_the_spot_beside_a_star_is_not_taken_for_the_star(el_px):
    sky = Sky((BEYOND_PX, el_px))
    star, looks = search(site_of(RIG, sky._site.clock), sky)
    assert star.flux_dn == LOOP.star_flux_dn
    assert looks == 0
    assert sky.brightest().flux_dn == LOOP.star_flux_dn  # and it stays on the frame


def test_the_search_goes_as_far_as_the_step_says_before():
    class Nowhere:
        motors = None
        goal_rad = np.zeros(2)
        farthest_rad = 0.0

        def brightest(self, *_):
            return None

        def turn_to(self, goal_rad):
            self.farthest_rad = max(self.farthest_rad, *np.abs(goal_rad))

    watch = Nowhere()
    with pytest.raises(StepError, match="no star"):
        search(site_of(), watch)
    assert f"up to {watch.farthest_rad:.1f} rad each way" in star_moves(site_of())


@pytest.mark.parametrize("part", [0.4, 0.5])
def test_a_dim_star_with_its_spot_beside_it_is_the_star_at_once(part):
    sky = Sky((RIG.camera.width_px / 2, 20.0), part)
    star, _ = search(site_of(RIG, sky._site.clock), sky)
    assert star.flux_dn == part * LOOP.star_flux_dn
    assert sky.bench.furthest_rad == 0.0


def test_a_dim_star_whose_spot_is_beyond_the_edge_is_the_star_where_it_was():
    sky = Sky((6.0, 20.0), FRINGE.flux_dn / LOOP.star_flux_dn)
    star, _ = search(site_of(RIG, sky._site.clock), sky)
    assert star.flux_dn == pytest.approx(FRINGE.flux_dn)
    assert 0.0 < sky.bench.furthest_rad < 2 * abs(FRINGE.offset_px.az) / PX_PER_RAD
    assert sky.bench.motor_rad == pytest.approx([0.0, 0.0], abs=0.02)
