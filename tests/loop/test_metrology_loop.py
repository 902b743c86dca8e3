"""A metrology loop finds its beam, holds it while the collector moves, and finds it again."""

import math

import numpy as np
import pytest
from beam_bench import Bench

from fitctl.drivers.interface import DeviceRefused, DeviceTimeout
from fitctl.logging.records import DeviceFailure, Event, ModeChange
from fitctl.loop.search.spiral import NEAR
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Mode, Trigger

AMPLITUDE_M, SLOW_HZ, FAST_HZ = 1e-3, 0.05, 0.5


def drift(time_s):
    return 1e-4 * time_s, 0.0


def sine(amplitude_m, frequency_hz):
    def collector_m(time_s):
        x_m = amplitude_m * math.sin(2 * math.pi * frequency_hz * time_s)
        return 0.8 * x_m, 0.6 * x_m

    return collector_m


def bench(*overrides, **options):
    return Bench(*overrides, **options)


def events(of):
    return [record.message for record in of.records if isinstance(record, Event)]


@pytest.mark.parametrize(
    "direction_deg",
    [pytest.param(deg, marks=[] if deg % 90 else pytest.mark.long) for deg in range(0, 360, 45)],
)
def test_a_beam_900_arcsec_off_is_found_and_held(direction_deg):
    angle = math.radians(direction_deg)
    one = bench(offset_arcsec=(900 * math.cos(angle), 900 * math.sin(angle)))
    one.power_up().acquire().until(Mode.LOCKED, limit_s=15.0)
    assert one.run(3.0).rms_arcsec(5.0) < 0.2


def test_a_beam_beyond_the_capture_radius_is_found_by_the_spiral():
    one = bench(offset_arcsec=(0.0, 1400.0))
    one.diodes.light = 0.05  # of a weak laser less is captured
    one.power_up().acquire().until(Mode.LOCKED, limit_s=30.0)
    assert [c.target for c in one.records if isinstance(c, ModeChange)] == [
        "STANDBY",
        "ACQUISITION",
        "COARSE",
        "LOCKED",
    ]


def test_without_a_beam_the_search_ends_in_standby_and_says_so():
    one = bench()
    one.diodes.light = 0.0
    one.power_up().acquire().until(Mode.STANDBY, limit_s=60.0)
    assert any("no beam within 930 arcsec" in text for text in events(one))


@pytest.mark.long
@pytest.mark.parametrize(
    ("collector_m", "bound_arcsec"),
    [
        (lambda _s: (0.0, 0.0), 0.15),
        (drift, 0.15),
        (sine(AMPLITUDE_M, SLOW_HZ), 0.4),
        (sine(AMPLITUDE_M / 10, FAST_HZ), 0.8),
    ],
    ids=["still", "drift", "slow sine", "fast sine"],
)
def test_the_beam_is_held_within_its_requirement(collector_m, bound_arcsec):
    one = bench(collector_m=collector_m).held()
    assert one.run(20.0).rms_arcsec(60.0) < bound_arcsec
    assert one.loop.mode is Mode.LOCKED


@pytest.mark.long
def test_the_second_integrator_removes_the_standing_error_of_a_drift():
    without = bench(collector_m=drift)
    without.loop.hold.second_per_s = 0.0
    without.held().run(20.0)
    assert abs(without.beam_arcsec()[0]) == pytest.approx(
        10e-6 * 206265 / without.loop.hold.gain_per_s, rel=0.3
    )
    with_it = bench(collector_m=drift).held().run(20.0)
    assert abs(with_it.beam_arcsec()[0]) < 0.1


@pytest.mark.long
def test_a_beam_cut_for_5_s_is_held_again_where_the_collector_has_gone():
    one = bench(collector_m=drift).held().run(10.0)
    one.diodes.light = 0.0
    one.until(Mode.ACQUISITION, limit_s=0.5).run(5.0)
    one.diodes.light = 1.0
    one.until(Mode.LOCKED, limit_s=5.0)
    assert any(isinstance(c, ModeChange) and c.trigger == "BEAM_LOST" for c in one.records)
    assert one.run(10.0).rms_arcsec(5.0) < 0.2


@pytest.mark.long
def test_a_beam_lost_for_a_moment_is_bridged_at_the_learnt_rate():
    one = bench(collector_m=drift).held().run(20.0)
    one.diodes.light = 0.0
    one.run(0.16)
    one.diodes.light = 1.0
    one.run(0.1)
    assert one.loop.mode is Mode.LOCKED
    assert abs(one.beam_arcsec()[0]) < 0.3


def test_a_beam_that_jumps_far_is_pulled_in_again():
    one = bench().held().run(2.0)
    one.offset_rad = one.offset_rad + np.array([2e-3, 0.0])
    one.until(Mode.COARSE, limit_s=1.0).until(Mode.LOCKED, limit_s=5.0)


def test_hold_leaves_the_siderostat_where_it_is():
    one = bench(collector_m=drift).held().run(2.0)
    one.loop.fire(Trigger.RELEASE, "test")
    before = one.motors.position_rad.copy()
    one.run(2.0)
    assert one.loop.mode is Mode.STANDBY
    assert np.abs(one.motors.position_rad - before).max() < 0.01


def test_an_error_of_the_photodiodes_makes_the_loop_safe_and_is_logged_once():
    one = bench().held()
    one.diodes.error = DeviceTimeout("photodiodes", "here", "a sample", "none")
    one.run(1.0)
    assert one.loop.mode is Mode.SAFE
    assert [r.device for r in one.records if isinstance(r, DeviceFailure)] == ["photodiodes"]


def test_a_fault_of_the_drive_makes_the_loop_safe():
    one = bench().held()
    one.motors.fault = "overcurrent"
    one.run(0.1)
    assert one.loop.mode is Mode.SAFE


def test_stop_is_obeyed_from_the_hold_and_recover_leads_back():
    one = bench().held()
    one.loop.fire(Trigger.STOP, "test")
    assert one.loop.mode is Mode.SAFE
    one.run(0.5)
    one.loop.servo.open()
    one.loop.begin(None)
    one.loop.fire(Trigger.RECOVER, "test")
    assert one.acquire().until(Mode.LOCKED, limit_s=5.0)


def test_a_saturated_photodiode_is_no_measurement():
    one = bench()
    one.truth = one.truth.model_copy(update={"on_axis_v": 30.0, "saturated_v": 10.2})
    one.power_up().acquire().run(5.0)
    assert one.loop.mode is Mode.COARSE
    assert {tick.beam_state for tick in one.ticks[-50:]} == {"SATURATED"}
    assert np.abs(one.beam_arcsec()).max() < 50


def test_the_search_goes_where_a_command_says():
    one = bench(offset_arcsec=(-600.0, 0.0))
    asked = Acquire(expected_az_sky_arcsec=600.0, expected_el_sky_arcsec=0.0)
    one.power_up().acquire(asked)
    assert one.loop.state(0.0).search_centre_sky_arcsec == pytest.approx((600.0, 0.0), abs=1e-6)
    one.until(Mode.LOCKED, limit_s=5.0)


def exhausted():
    """A bench whose search has found nothing, and whose laser is back; its siderostat is far from the start."""
    bench = Bench(offset_arcsec=(250.0, -100.0)).power_up()
    bench.diodes.light = 0.0
    bench.acquire().until(Mode.STANDBY, limit_s=60.0)
    assert np.abs(bench.motors.position_rad).max() > 40.0
    bench.diodes.light = 1.0
    return bench


def test_a_search_that_found_nothing_is_repeated_about_the_same_place():
    bench = exhausted().acquire()
    assert np.allclose(bench.loop.search.centre_rad, 0.0)
    bench.until(Mode.LOCKED)
    bench.loop.fire(Trigger.RELEASE, "test")
    bench.acquire()
    assert bench.loop.search.centre_rad == pytest.approx(bench.loop.servo.position_rad)


def test_the_spiral_begins_when_the_siderostat_has_come_to_its_middle():
    bench = exhausted()
    bench.diodes.light = 0.0
    bench.acquire()
    bench.tick()
    while bench.loop.search.progress == 0.0:
        bench.tick()
        assert bench.clock.now_s() < 100.0
    near_px = NEAR * bench.loop.search._plan.field_radius_px
    away_px = np.abs(bench.loop.servo.position_rad).max() * bench.loop.search._px_per_motor_rad
    assert away_px < 1.2 * near_px


def test_a_search_ends_if_the_siderostat_does_not_come_to_its_middle():
    search, motor_rad = Bench().loop.search, np.zeros(2)
    asked = Acquire(expected_az_sky_arcsec=600.0, expected_el_sky_arcsec=0.0)
    search.start_as_asked(asked, motor_rad, again=False)
    for time_s in (0.0, 10.0):
        search.advance_from(motor_rad, motor_rad, 0.02)
        assert search.evaluate(False, motor_rad, time_s) is None
    finding = search.evaluate(False, motor_rad, 1000.0)
    assert finding.trigger is Trigger.SEARCH_EXHAUSTED
    assert "did not reach the start of the search" in finding.reason


def test_a_siderostat_on_its_way_to_a_search_stops_when_an_interlock_holds_it_and_goes_on_later():
    row = "quantity='siderostat_travel_fraction', high=0.2, for_s=0.0, modes=['ACQUISITION']"
    one = bench(
        f"interlocks.far={{{row}, action='freeze', reset='hand'}}", offset_arcsec=(-600.0, 0.0)
    )
    one.diodes.light = 0.0
    one.power_up().acquire(Acquire(expected_az_sky_arcsec=600.0, expected_el_sky_arcsec=0.0))
    while not one.loop.interlocks.holds:
        one.tick()
    stopped_rad = one.motors.position_rad.copy()
    one.run(one.loop.search._slew_limit_s + 3.0)
    assert one.motors.position_rad == pytest.approx(stopped_rad, abs=1.5)  # it brakes and returns
    assert one.loop.mode is Mode.ACQUISITION

    one.loop.interlocks._rules["far"].high = 1.0
    assert not one.loop.reset_interlock("far")
    one.diodes.light = 1.0

    one.until(Mode.LOCKED, limit_s=5.0)


def test_after_a_jog_the_search_begins_where_the_siderostat_was_turned_to():
    bench = exhausted()
    stood_rad = bench.loop.siderostat.setpoint_rad.copy()
    bench.loop.jog(np.array([-20.0, 0.0]))
    bench.run(1.0).acquire()
    assert np.abs(bench.loop.search.centre_rad - stood_rad).max() < 10.0


def test_encoders_that_lost_their_zero_begin_the_search_where_the_siderostat_is():
    bench = exhausted()
    bench.loop.servo.encoders_jumped = True
    bench.loop.begin(None)
    bench.acquire()
    assert np.abs(bench.loop.search.centre_rad).max() > 40.0


def test_the_tick_says_where_the_beam_is():
    one = bench().held().run(3.0)
    tick = one.ticks[-1]
    assert tick.beam_state == "MEASURED"
    assert tick.beam_az_arcsec == pytest.approx(one.beam_arcsec()[0], abs=0.3)
    assert tick.noise_az_arcsec == pytest.approx(0.038, rel=0.05)


def test_two_failures_of_one_device_that_alternate_are_reported_once_each():
    one = bench().power_up()
    silent = DeviceTimeout("photodiodes", "here", "a sample", "none")
    refused = DeviceRefused("photodiodes", "here", "a sample", "a refusal")
    for error in (silent, refused) * 3:
        one.loop.device_failed("photodiodes", error)

    assert one.loop.mode is Mode.SAFE
    reported = [text for text in events(one) if "expected a sample" in text]
    assert len(reported) == 2
    assert len([r for r in one.records if isinstance(r, DeviceFailure)]) == 2


def test_at_its_travels_end_a_siderostat_learns_no_rate_and_follows_the_beam_back():
    def there_and_back(time_s):
        drifted_s = max(0.0, time_s - 10.0)
        return 1e-4 * min(drifted_s, max(0.0, 40.0 - drifted_s)), 0.0

    one = bench(collector_m=there_and_back).held()
    one.run(26.0 - one.clock.now_s())
    one.loop.siderostat.travel_rad = np.abs(one.loop.siderostat.setpoint_rad).max()
    one.run(6.0)
    assert one.loop.siderostat.wanted_fraction > 1.0

    one.run(4.0)  # 2 s ago the beam was back where the siderostat stopped
    assert one.rms_arcsec(5.0) < 0.2
    assert "LOCKED -> COARSE" not in str(events(one))
