"""The step `travel`: to both ends and back, and where a motor stops before them."""

import pytest
from commissioning.motor_bench import RIG, rig_with_limit, site_of, step_on_bench

from fitctl.commissioning.steps.travel import FAST_RAD_S, OF_TRAVEL, check_travel, moves

TRAVEL_RAD = RIG.loops["right"].siderostat.travel_rad


@pytest.fixture
def step(monkeypatch):
    return step_on_bench(monkeypatch, check_travel)


@pytest.mark.long
def test_both_motors_go_to_both_ends_and_back_and_never_beyond(step):
    bench, outcome, _ = step()
    assert outcome.state == "passed"
    for name in ("azimuth", "elevation"):
        for end, sign in (("high", 1), ("low", -1)):
            reached_rad = outcome.figures[f"{name}_reached_{end}_rad"]
            assert reached_rad == pytest.approx(sign * OF_TRAVEL * TRAVEL_RAD, abs=0.1)
    assert bench.furthest_rad < TRAVEL_RAD
    assert bench.fastest_rad_s <= FAST_RAD_S
    assert abs(bench.motor_rad).max() < 0.1
    assert not bench.powered


@pytest.mark.parametrize(("ends_rad", "at"), [((-30.0, 1e9), "-30.0"), ((-1e9, 1.0), "+1.0")])
def test_a_motor_that_stops_before_its_travel_is_named_with_its_place_and_goes_back(
    step, ends_rad, at
):
    bench, _, error = step(ends_rad=ends_rad)
    assert f"azimuth stopped at {at} rad" in error
    assert "travel_sky_arcsec" in error
    assert abs(bench.motor_rad).max() < 0.1
    assert not bench.powered


def test_a_motor_that_turns_the_other_way_ends_the_step_soon(step):
    bench, _, error = step(gains=((-1, 0), (0, 1)))
    assert "repeat the step amplifiers" in error
    assert bench.furthest_rad < 1.0
    assert not bench.powered


def test_a_motor_that_moves_with_the_other_is_named(step):
    bench, _, error = step(gains=((1, 0), (1, 1)))
    assert "elevation moved while azimuth was commanded" in error
    assert bench.furthest_rad < 1.0


@pytest.mark.parametrize("limit_rad_s", [2.0, 5.0, 10.0])
def test_the_motors_turn_no_faster_than_their_limit(step, limit_rad_s):
    rig = rig_with_limit(limit_rad_s)
    bench, _, error = step(rig, ends_rad=(-1e9, 8.0))
    assert "azimuth stopped at +8.0 rad" in error
    assert bench.fastest_rad_s == limit_rad_s
    assert f"at {limit_rad_s:g} rad/s and" in moves(site_of(rig))
    assert f"at {min(limit_rad_s, 3.0):g} rad/s;" in moves(site_of(rig))
