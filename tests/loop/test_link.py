"""A stellar loop whose light comes over a link: held while the link moves, waiting while it is lost."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import Event, ModeChange, Overlap, Tick
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    Jog,
    Off,
    Recover,
    Release,
    Reset,
    SetController,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive, standstill
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import true_residual_rms

RIG = default_rig_path().with_name("fit-testbed.toml")
NEAR = (3.0, -2.0)  # px: both stars are in the field from the start
STILL = "collector.motion.kind=still"
METROLOGY, LEFT, RIGHT = "metrology", "left", "right"


class Drift:
    """The collector's array moves at a steady velocity across the link."""

    def __init__(self, mm_s, start_s):
        self.mm_s, self.start_s = mm_s, start_s

    def pose_at(self, time_s):
        moved_mm = self.mm_s * np.maximum(np.asarray(time_s) - self.start_s, 0.0)
        pose = np.zeros((*moved_mm.shape, 6))
        pose[..., 1] = moved_mm
        return pose


class Sine(Drift):
    """It moves to and fro by `mm_s` millimetres, every two seconds."""

    def pose_at(self, time_s):
        passed_s = np.maximum(np.asarray(time_s) - self.start_s, 0.0)
        pose = np.zeros((*passed_s.shape, 6))
        pose[..., 1] = self.mm_s * np.sin(np.pi * passed_s)
        return pose


class Testbed:
    """The whole testbed, simulated; its `records` are all that it made but frames."""

    __test__ = False

    def __init__(self, *overrides, seed=0, star_offset_px=NEAR):
        self.records = []
        self.simulation = Simulation(
            load_rig(RIG, [STILL, *overrides]),
            seed,
            star_offset_px=star_offset_px,
            record=self.records.append,
            history_s=60.0,
        )
        self.supervisor, self.clock = self.simulation.supervisor, self.simulation.clock
        self.run, self.command = self.simulation.run, self.simulation.command

    def loop(self, name):
        return self.supervisor.loops[name]

    def modes(self):
        return {name: loop.mode for name, loop in self.supervisor.loops.items()}

    def until(self, limit_s=40.0, **modes):
        end_s = self.clock.now_s() + limit_s
        while any(self.loop(name).mode is not mode for name, mode in modes.items()):
            assert self.clock.now_s() < end_s, f"{self.modes()}, wanted {modes}"
            self.run(0.02)
        return self

    def held(self):
        self.simulation.acquire()
        return self.until(metrology=Mode.LOCKED, left=Mode.VERNIER, right=Mode.VERNIER)

    def swing(self, amplitude_mm):
        self.simulation.plant.collector.follow(Sine(amplitude_mm, self.clock.now_s()))

    def drift(self, mm_s):
        self.simulation.plant.collector.follow(Drift(mm_s, self.clock.now_s()))

    def laser(self, power):
        self.simulation.plant.loops[METROLOGY].inputs.laser[:] = power

    def darken(self, name):
        """Cover one loop's spots; what uncovers them."""
        scene, spots = self.simulation.camera._scene, [2 * [one] for one in (RIGHT, LEFT)]
        light_dn = scene._flux_dn
        scene._flux_dn = light_dn * np.array([one != name for pair in spots for one in pair])
        return lambda: setattr(scene, "_flux_dn", light_dn)

    def star_px(self, name):
        now_s = self.clock.now_s()
        return self.simulation.plants[name].history_px(now_s - 0.02, now_s)[-1, 0, 0]

    def rms_px(self, name, since_s):
        return true_residual_rms(
            self.simulation.plants[name],
            self.supervisor.stellar_loops[name].target_px,
            since_s,
            self.clock.now_s(),
        )

    def first_change(self, name, **fields):
        return next(
            record
            for record in self.records
            if isinstance(record, ModeChange)
            and record.loop == name
            and all(getattr(record, key) == value for key, value in fields.items())
        )

    def events(self, source):
        return [r for r in self.records if isinstance(r, Event) and r.source == source]


@pytest.fixture
def held():
    return Testbed().held()


@pytest.mark.long
def test_one_command_brings_all_up_in_the_order_in_which_they_depend_on_each_other():
    testbed = Testbed(star_offset_px=None).held()
    locked_s = testbed.first_change(METROLOGY, target="LOCKED").time_s
    went_on = [e for e in testbed.events(LEFT) if "no longer waits" in e.message]
    assert went_on
    assert went_on[0].time_s > locked_s
    assert testbed.first_change(LEFT, target="COARSE").time_s > went_on[0].time_s
    # The right loop needs no link.
    assert testbed.first_change(RIGHT, target="ACQUISITION").time_s < locked_s
    assert testbed.clock.now_s() < 60.0


@pytest.mark.long
def test_the_left_star_stays_while_the_collector_drifts(held):
    held.drift(0.1)
    held.run(10.0)
    since_s = held.clock.now_s()
    held.run(30.0)
    assert held.rms_px(LEFT, since_s).max() < 0.03
    assert held.rms_px(RIGHT, since_s).max() < 0.03


@pytest.mark.long
def test_with_a_gain_of_0_the_drift_is_left_to_the_mirror():
    testbed = Testbed("loops.left.feedforward.gain=0.0").held()
    testbed.drift(0.1)
    testbed.run(30.0)
    since_s = testbed.clock.now_s() - 10.0
    assert "it is another star" not in str(testbed.events(LEFT))
    assert testbed.rms_px(LEFT, since_s).max() > 0.2
    assert testbed.rms_px(RIGHT, since_s).max() < 0.03


UNEQUAL = (
    "plant.loops.left.backlash_sky_arcsec=2.0",
    "loops.left.siderostat.backlash_sky_arcsec=2.0",
)


@pytest.mark.long
def test_plays_that_are_not_alike_are_made_up_for_by_the_mirror_if_it_is_told_to():
    rms_px = {}
    for signal in ("encoders", "encoders+backlash"):
        testbed = Testbed(*UNEQUAL, f"loops.left.feedforward.signal={signal}").held()
        testbed.swing(0.1)
        testbed.run(10.0)
        since_s = testbed.clock.now_s()
        testbed.run(20.0)
        rms_px[signal] = testbed.rms_px(LEFT, since_s).max()
        assert testbed.loop(LEFT).mode is Mode.VERNIER
    assert rms_px["encoders"] > 0.06
    assert rms_px["encoders+backlash"] < 0.5 * rms_px["encoders"]


@pytest.mark.long
def test_the_mirror_does_not_jump_as_it_begins_to_make_up_for_backlash():
    testbed = Testbed(*UNEQUAL, "loops.left.feedforward.signal=encoders+backlash").held()
    testbed.run(5.0)
    mirror = testbed.loop(LEFT).mirror
    before_rad = mirror.command_rad.copy()
    testbed.command(SetController(loop=LEFT, name="minimum-variance"))
    testbed.run(0.04)
    assert mirror.command_rad == pytest.approx(before_rad, abs=4e-6)  # 0.15 px


@pytest.mark.long
def test_the_siderostats_turn_against_each_other(held):
    before = {name: held.loop(name).siderostat.setpoint_rad.copy() for name in (METROLOGY, LEFT)}
    held.drift(0.5)
    held.run(10.0)
    turned = {
        name: held.loop(name).siderostat.setpoint_rad - before[name] for name in (METROLOGY, LEFT)
    }
    assert abs(turned[METROLOGY][0]) > 5.0  # 5 mm over 10 m are 103 arcsec, or 6.4 rad
    assert turned[LEFT] == pytest.approx(-turned[METROLOGY], abs=0.15)


@pytest.mark.long
def test_when_the_laser_is_cut_left_holds_in_the_same_tick_and_goes_on_by_itself(held):
    held.drift(0.1)
    held.run(5.0)
    held.laser(0.0)
    held.until(limit_s=1.0, metrology=Mode.ACQUISITION)
    lost = held.first_change(METROLOGY, trigger="BEAM_LOST")
    (waits,) = [e for e in held.events(LEFT)[-1:] if "waits for the link" in e.message]
    assert waits.time_s - lost.time_s < 0.02
    assert "waits for the link of metrology" not in held.loop(RIGHT).state(0.0).waits_for
    assert "the link of metrology" in held.loop(LEFT).state(0.0).waits_for
    stood_rad = held.loop(LEFT).siderostat.setpoint_rad.copy()
    mirror_rad = held.loop(LEFT).mirror.command_rad.copy()
    held.run(5.0)
    assert held.loop(LEFT).siderostat.setpoint_rad == pytest.approx(stood_rad)
    assert held.loop(LEFT).mirror.command_rad == pytest.approx(mirror_rad)
    assert held.loop(RIGHT).mode is Mode.VERNIER
    held.laser(1.0)
    held.until(limit_s=10.0, metrology=Mode.LOCKED)
    held.run(1.0)
    held.until(limit_s=30.0, left=Mode.VERNIER)
    assert held.loop(LEFT).state(0.0).waits_for == ""
    held.run(5.0)
    since_s = held.clock.now_s()
    held.run(5.0)
    assert held.rms_px(LEFT, since_s).max() < 0.05


def on_its_way_back(held):
    """A link that ran away before it was given up took left along: 70 rad, more than a second. Left's loop."""
    held.laser(0.0)
    held.until(limit_s=1.0, metrology=Mode.ACQUISITION)
    left = held.loop(LEFT)
    left.siderostat.move_by(np.array([70.0, 0.0]))
    held.run(3.0)
    held.laser(1.0)
    held.until(limit_s=10.0, metrology=Mode.LOCKED)
    left.siderostat.move_by(np.array([-70.0, 0.0]))
    held.run(1.0)
    return left


@pytest.mark.long
def test_after_the_links_return_left_waits_until_its_own_siderostat_is_back_too(held):
    left = on_its_way_back(held)
    assert left.waits_for == "its siderostat, which is on its way to the star"
    held.run(2.0)

    assert left.waits_for == ""
    assert held.modes()[LEFT] is Mode.VERNIER
    assert "no longer waits for its siderostat" in str(held.events(LEFT)[-3:])
    since_s = held.clock.now_s() + 2.0
    held.run(7.0)
    assert held.rms_px(LEFT, since_s).max() < 0.05


@pytest.mark.long
@pytest.mark.parametrize("action", ["freeze", "flatten"])
def test_a_siderostat_on_its_way_back_to_its_star_stops_for_an_interlock_and_goes_on(action):
    row = (
        "{quantity='siderostat_travel_fraction', high=1.0, for_s=0.0, modes=['VERNIER'], "
        f"action='{action}', reset='hand'}}"
    )
    held = Testbed(f"interlocks.far={row}").held()
    left = on_its_way_back(held)

    rule = left.interlocks._rules["far"]
    rule.high = 0.001
    held.run(0.5)
    assert left.tick_record().held
    stopped_rad = left.servo.position_rad
    held.run(5.0)
    assert left.servo.position_rad == pytest.approx(stopped_rad, abs=0.5)
    assert left.waits_for == "its siderostat, which is on its way to the star"
    rule.high = 1.0
    assert held.command(Reset(loop=LEFT, name="far")).accepted

    held.run(4.0)
    assert left.mode is Mode.VERNIER
    assert left.waits_for == ""
    since_s = held.clock.now_s() + 2.0
    held.run(7.0)
    assert held.rms_px(LEFT, since_s).max() < 0.05


@pytest.mark.long
def test_a_metrology_loop_that_is_stopped_and_brought_back_finds_left_waiting(held):
    assert held.command(Stop(loop=METROLOGY)).accepted
    held.run(3.0)
    assert held.modes() == {
        METROLOGY: Mode.SAFE,
        LEFT: Mode.VERNIER,
        RIGHT: Mode.VERNIER,
    }
    assert held.loop(LEFT).waits_for
    assert held.command(Recover(loop=METROLOGY)).accepted
    held.run(0.5)
    assert held.command(Acquire(loop=METROLOGY)).accepted
    held.until(limit_s=10.0, metrology=Mode.LOCKED)
    held.run(1.0)
    held.until(limit_s=20.0, left=Mode.VERNIER)


@pytest.mark.long
def test_hold_ends_the_waiting(held):
    held.command(Release(loop=METROLOGY))
    held.run(0.1)
    assert held.loop(LEFT).waits_for
    held.command(Release(loop=LEFT))
    held.run(0.1)
    assert held.loop(LEFT).mode is Mode.STANDBY
    assert not held.loop(LEFT).waits_for


@pytest.mark.long
def test_neither_loop_takes_the_others_star_while_one_is_away(held):
    for away, stays in ((RIGHT, LEFT), (LEFT, RIGHT)):
        uncover = held.darken(away)
        since_s = held.clock.now_s()
        held.run(8.0)
        assert held.loop(away).mode is Mode.ACQUISITION
        assert held.loop(stays).mode is Mode.VERNIER
        assert held.rms_px(stays, since_s).max() < 0.03
        uncover()
        held.until(limit_s=40.0, **{away: Mode.VERNIER})
        since_s = held.clock.now_s()
        held.run(3.0)
        assert held.rms_px(away, since_s).max() < 0.1


@pytest.mark.long
def test_a_star_that_the_link_carries_to_where_the_candidate_is_expected_is_not_its_own(held):
    """Only the star of left is on the frame, and left waits for its link, whose siderostat is jogged."""
    held.command(Release())
    held.darken(RIGHT)
    left, right = held.loop(LEFT), held.loop(RIGHT)
    for command in (Acquire(loop=LEFT), Acquire(loop=RIGHT)):
        assert held.command(command).accepted
    while right.star_finder.attribution.candidate is None:
        held.run(0.02)
        assert right.mode is Mode.ACQUISITION
    since_s = held.clock.now_s()
    link = left.star_motion.link
    moves_px = right.target_px - held.star_px(LEFT)
    link_rad = np.linalg.solve(link.matrix, left._scale.motor_rad(moves_px))
    per_rad = link.loop.settings.siderostat.sky_arcsec_per_motor_rad
    az, el = (per_rad * link_rad).tolist()
    assert held.command(Jog(loop=METROLOGY, az_sky_arcsec=az, el_sky_arcsec=el)).accepted
    held.run(1.5)
    assert held.star_px(LEFT) == pytest.approx(right.target_px, abs=2.0)
    assert "link of metrology" in left.waits_for
    held.run(5.0)
    assert not [
        change
        for change in held.records
        if isinstance(change, ModeChange) and change.loop == RIGHT and change.time_s > since_s
    ]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_each_loop_finds_its_own_star_though_both_are_in_the_field(seed):
    testbed = Testbed(seed=seed).held()
    testbed.run(10.0)
    since_s = testbed.clock.now_s()
    testbed.run(3.0)
    for name in (LEFT, RIGHT):
        assert testbed.rms_px(name, since_s).max() < 0.05


@pytest.mark.long
@pytest.mark.parametrize("fringe_az_px", [26.5, 25.0, 23.5])
def test_a_loop_is_not_pulled_by_the_other_loops_fringe_spot(held, fringe_az_px):
    """Left is pointed so that its fringe spot, 8 px beside its star, lies near right's star at az 28 px."""
    assert held.command(SetTarget(loop=LEFT, az_px=fringe_az_px - 8.0, el_px=20.0)).accepted
    held.run(15.0)
    since_s = held.clock.now_s()
    held.run(5.0)
    assert held.modes() == {RIGHT: Mode.VERNIER, METROLOGY: Mode.LOCKED, LEFT: Mode.VERNIER}
    assert held.rms_px(RIGHT, since_s).max() < 0.03


@pytest.mark.long
def test_each_frames_tilt_between_the_stars_and_its_visibility_are_recorded(held):
    held.run(5.0)
    overlaps = [record for record in held.records if isinstance(record, Overlap)][-100:]
    ticks = {(tick.loop, tick.number): tick for tick in held.records if isinstance(tick, Tick)}
    arcsec_per_px = held.loop(LEFT).state(0.0).sky_arcsec_per_px
    for overlap in overlaps:
        left, right = (ticks[name, overlap.number] for name in (LEFT, RIGHT))
        tilt_px = (left.star_az_px - 12.0) - (right.star_az_px - 28.0)
        assert overlap.tilt_az_arcsec == pytest.approx(arcsec_per_px * tilt_px)
    assert np.mean([overlap.visibility for overlap in overlaps]) > 0.95


def test_before_both_stars_are_followed_there_is_no_visibility():
    testbed = Testbed()
    testbed.simulation.acquire()
    testbed.run(0.2)
    overlaps = [record for record in testbed.records if isinstance(record, Overlap)]
    assert overlaps
    assert np.isnan([overlap.visibility for overlap in overlaps]).all()


@pytest.mark.long
def test_what_was_turned_before_the_links_encoders_lost_their_zero_is_not_undone(held):
    stood_rad = held.loop(LEFT).siderostat.setpoint_rad.copy()
    for command in (Stop(loop=METROLOGY), Off(loop=METROLOGY)):
        assert held.command(command).accepted
        held.run(0.1)
    amplifiers = held.simulation.devices.loops[METROLOGY].amplifiers
    exchange = amplifiers.exchange

    def from_another_zero(velocity_rad_s):
        reading = exchange(velocity_rad_s)
        az_rad, el_rad = reading.position_rad
        return reading._replace(position_rad=(az_rad + 3.0, el_rad))

    amplifiers.exchange = from_another_zero
    for command in (Standby(loop=METROLOGY), Acquire(loop=METROLOGY)):
        assert held.command(command).accepted
        held.run(0.1)
    held.until(limit_s=10.0, metrology=Mode.LOCKED)
    held.run(0.1)
    assert held.loop(LEFT).siderostat.setpoint_rad == pytest.approx(stood_rad, abs=0.3)
    held.run(3.0)
    held.until(limit_s=20.0, left=Mode.VERNIER)


@pytest.mark.long
def test_a_place_that_a_command_gives_is_one_with_the_link_as_it_is(held):
    """It is that of the siderostat's own encoders, wherever the link's siderostat has turned."""
    held.drift(0.3)
    held.run(30.0)
    siderostat = held.loop(LEFT).settings.siderostat
    arcsec_per_rad = siderostat.sky_arcsec_per_motor_rad
    az_arcsec, el_arcsec = (-arcsec_per_rad * held.loop(LEFT).servo.position_rad).tolist()
    assert held.command(Release(loop=LEFT)).accepted
    held.run(0.5)
    asked = Acquire(
        loop=LEFT,
        search_radius_sky_arcsec=20.0,
        expected_az_sky_arcsec=az_arcsec,
        expected_el_sky_arcsec=el_arcsec,
    )
    assert held.command(asked).accepted
    held.until(8.0, left=Mode.VERNIER)


class LooseDiode:
    """The photodiodes of a loop, of which one reads nothing."""

    def __init__(self, photodiodes, index):
        self._photodiodes, self._index = photodiodes, index
        self.send_request = photodiodes.send_request

    def receive(self):
        sample = self._photodiodes.receive()
        if sample is None:
            return None
        volts = [0.0 if n == self._index else volt for n, volt in enumerate(sample.volts)]
        return sample._replace(volts=tuple(volts))


@pytest.mark.parametrize("travel_rad", [74.0, 1.0], ids=["far from its end", "near its end"])
@pytest.mark.long
def test_a_photodiode_that_comes_loose_for_a_second_turns_the_left_siderostat_little_and_costs_no_star(
    held, travel_rad
):
    held.run(2.0)
    metrology, siderostat = held.loop(METROLOGY), held.loop(LEFT).siderostat
    siderostat.travel_rad = travel_rad
    assert travel_rad > np.abs(siderostat.setpoint_rad).max()
    photodiodes, before_rad = metrology._photodiodes, siderostat.setpoint_rad
    held.records.clear()
    metrology._photodiodes = LooseDiode(photodiodes, index=1)
    held.run(1.0)
    turned_rad = np.abs(siderostat.setpoint_rad - before_rad).max()
    assert turned_rad * held.loop(LEFT).settings.siderostat.sky_arcsec_per_motor_rad < 60.0
    metrology._photodiodes = photodiodes
    held.until(metrology=Mode.LOCKED).run(3.0)
    changes = [record for record in held.records if isinstance(record, ModeChange)]
    assert [(change.loop, change.target) for change in changes] == [
        (METROLOGY, "COARSE"),
        (METROLOGY, "LOCKED"),
    ]
    assert siderostat.setpoint_rad == pytest.approx(before_rad, abs=0.2)
    rms_px = held.rms_px(LEFT, held.clock.now_s() - 1.0)
    assert (rms_px < held.loop(LEFT).settings.requirement_px).all()


@pytest.mark.long
def test_a_star_that_moves_while_its_link_is_lost_is_held_again_without_a_search():
    moves = "loops.left.star_rate_sky_arcsec_s={az=12.0, el=-9.0}"
    one = Testbed(moves, f"plant.{moves}").held()
    one.run(2.0)
    one.records.clear()
    one.laser(0.0)
    one.run(20.0)  # 300 arcsec
    one.laser(1.0)
    one.until(metrology=Mode.LOCKED).run(3.0)
    changes = [record for record in one.records if isinstance(record, ModeChange)]
    assert {change.loop for change in changes} == {METROLOGY}
    assert (one.rms_px(LEFT, one.clock.now_s() - 1.0) < 0.05).all()


@pytest.mark.parametrize("amplitude_mm", [0.5, -0.5])
@pytest.mark.long
def test_a_link_that_turns_beyond_the_left_siderostats_travel_and_back_leaves_it_where_it_was(
    held, amplitude_mm
):
    held.run(2.0)
    siderostat = held.loop(LEFT).siderostat
    before_rad = siderostat.setpoint_rad
    held.swing(amplitude_mm)  # 0.6 rad: the mirror makes up for what is beyond
    siderostat.travel_rad = np.abs(before_rad).max() + 0.1
    farthest = 0.0
    for _ in range(100):
        held.run(0.02)
        farthest = max(farthest, siderostat.wanted_fraction)
    assert farthest > 1.3
    assert siderostat.setpoint_rad == pytest.approx(before_rad, abs=0.2)


@pytest.mark.long
def test_an_experiment_meanwhile_changes_nothing_of_that(held):
    held.run(2.0)
    siderostat = held.loop(LEFT).siderostat
    before_rad = siderostat.setpoint_rad
    held.swing(0.5)
    siderostat.travel_rad = np.abs(before_rad).max() + 0.1
    held.run(0.5)
    assert siderostat.wanted_fraction > 1.3
    assert held.command(Experiment(loop=LEFT, name="rest", drives=standstill(0.2))).accepted
    held.run(1.5)
    assert held.first_change(LEFT, trigger="EXPERIMENT_DONE")
    assert siderostat.setpoint_rad == pytest.approx(before_rad, abs=0.2)


@pytest.mark.long
def test_the_stages_of_an_experiment_that_the_loss_of_the_link_ends_stay_until_it_is_back(held):
    left, held_rad = held.loop(LEFT), held.loop(LEFT).siderostat.setpoint_rad.copy()
    square = {"shape": "square", "amplitude": 5.0, "frequency_hz": 0.02, "duration_s": 60.0}
    drive = Drive(channel="siderostat_az", **square)
    assert held.command(Experiment(loop=LEFT, name="step", drives=[drive])).accepted
    held.run(1.0)
    held.laser(0.0)
    while not left.waits_for:
        held.run(0.02)
    stopped_rad = left.servo.position_rad
    held.run(2.0)
    assert held.first_change(LEFT, trigger="EXPERIMENT_DONE")
    assert np.abs(stopped_rad - held_rad).max() > 0.5
    assert left.servo.position_rad == pytest.approx(stopped_rad, abs=0.05)

    held.records.clear()
    held.laser(1.0)
    held.until(metrology=Mode.LOCKED, left=Mode.VERNIER)
    changes = [record for record in held.records if isinstance(record, ModeChange)]
    assert not [
        change for change in changes if change.loop == LEFT and change.target == "ACQUISITION"
    ]


@pytest.mark.long
def test_a_frozen_loop_that_lost_its_star_finds_it_again():
    one = Testbed('interlocks.flux_low.action="freeze"').held()
    one.run(1.0)
    scene = one.simulation.camera._scene
    light_dn = scene._flux_dn
    scene._flux_dn = light_dn * 0.6
    one.run(2.0)
    assert one.loop(LEFT).interlocks.holds
    one.laser(0.0)
    one.drift(1.0)
    one.run(8.0)  # the star is then beside the frame
    one.drift(0.0)
    one.laser(1.0)
    scene._flux_dn = light_dn
    one.until(metrology=Mode.LOCKED, left=Mode.VERNIER)


FAR = {"expected_az_sky_arcsec": 900.0, "expected_el_sky_arcsec": 0.0}


def sky_az_arcsec(loop):
    return float(loop.servo.position_rad[0]) * loop.settings.siderostat.sky_arcsec_per_motor_rad


def sent_far_away(held, **asked):
    """Left is on its way to a search when its link is lost; where it is when it begins to wait."""
    left = held.loop(LEFT)
    assert held.command(Release(loop=LEFT)).accepted
    held.run(0.5)
    assert held.command(Acquire(loop=LEFT, **FAR, **asked)).accepted
    held.run(0.1)
    held.laser(0.0)
    while not left.waits_for:
        held.run(0.02)
    assert left.mode is Mode.ACQUISITION
    return sky_az_arcsec(left)


@pytest.mark.long
def test_a_siderostat_on_its_way_to_a_search_stops_when_its_link_is_lost_and_goes_on_with_it(held):
    left, stopped_arcsec = held.loop(LEFT), sent_far_away(held, search_radius_sky_arcsec=20.0)
    held.run(1.0)
    assert sky_az_arcsec(left) == pytest.approx(stopped_arcsec, abs=25.0)  # it brakes and returns
    assert abs(stopped_arcsec) < 500.0
    held.run(left.search._slew_limit_s + 3.0)
    assert sky_az_arcsec(left) == pytest.approx(stopped_arcsec, abs=25.0)
    assert held.loop(LEFT).state(0.0).waits_for

    held.laser(1.0)
    held.until(limit_s=20.0, metrology=Mode.LOCKED)
    held.until(limit_s=20.0, left=Mode.STANDBY)

    assert "no star within 20 arcsec" in left.last_change.reason
    assert abs(sky_az_arcsec(left)) > 800.0


def test_a_candidate_is_looked_at_again_after_the_link_was_lost():
    held = Testbed().held()
    left = held.loop(LEFT)
    held.command(Release(loop=LEFT))
    held.run(0.5)
    held.command(Acquire(loop=LEFT))
    while left.star_finder.attribution.candidate is None:
        held.run(0.02)
    held.laser(0.0)
    held.run(5.0)
    assert left.waits_for
    assert left.star_finder.attribution.candidate is not None

    held.laser(1.0)
    held.until(limit_s=20.0, left=Mode.COARSE)

    assert not [e for e in held.events(LEFT) if "was not confirmed" in e.message]


@pytest.mark.long
def test_the_time_of_a_search_for_a_star_that_was_lost_does_not_run_while_it_waits():
    held = Testbed("loops.left.acquisition.search_again_s=20.0").held()
    uncover = held.darken(LEFT)
    held.until(limit_s=2.0, left=Mode.ACQUISITION).run(2.0)
    held.laser(0.0)
    held.run(22.0)
    assert held.loop(LEFT).waits_for

    uncover()
    held.laser(1.0)
    held.until(limit_s=20.0, left=Mode.COARSE)


@pytest.mark.parametrize("waited_s", [0.1, 20.0])
@pytest.mark.long
def test_a_place_that_a_command_gives_is_that_of_a_moving_star_when_it_is_given(waited_s):
    moves = "loops.left.star_rate_sky_arcsec_s={az=12.0, el=-9.0}"
    held = Testbed(moves, f"plant.{moves}").held()
    left = held.loop(LEFT)
    held.command(Release(loop=LEFT))
    held.laser(0.0)
    held.run(1.5)
    on_target_rad = left.servo.position_rad + left._scale.motor_rad(
        left.target_px - held.star_px(LEFT)
    )
    az, el = (-on_target_rad * left.settings.siderostat.sky_arcsec_per_motor_rad).tolist()
    asked = Acquire(
        loop=LEFT,
        expected_az_sky_arcsec=az,
        expected_el_sky_arcsec=el,
        rate_az_sky_arcsec_s=12.0,
        rate_el_sky_arcsec_s=-9.0,
        search_radius_sky_arcsec=40.0,
    )
    assert held.command(asked).accepted
    held.run(waited_s)

    held.laser(1.0)
    held.until(limit_s=20.0, left=Mode.COARSE)


WITH_BACKLASH = (*UNEQUAL, "loops.left.feedforward.signal=encoders+backlash")


def mirror_px(loop):
    return loop.mirror.command_rad * loop._scale.mirror_px_per_rad


@pytest.mark.long
def test_what_the_plays_have_lost_before_the_star_is_held_moves_no_mirror():
    testbed = Testbed(*WITH_BACKLASH)
    testbed.simulation.acquire()
    testbed.until(left=Mode.COARSE)
    while testbed.loop(LEFT).mode is Mode.COARSE:
        before_px = mirror_px(testbed.loop(LEFT))
        testbed.run(0.02)
    assert mirror_px(testbed.loop(LEFT)) == pytest.approx(before_px, abs=0.1)


@pytest.mark.long
def test_a_mirror_that_holds_a_star_again_has_no_offset_left_from_before():
    testbed = Testbed(*WITH_BACKLASH).held()
    testbed.swing(0.1)
    testbed.run(3.0)
    left = testbed.loop(LEFT)
    offsets_px = np.abs(left.backlash.offset_rad) * left._scale.mirror_px_per_rad
    assert offsets_px.max() > 0.02
    testbed.drift(0.0)
    testbed.command(Release(loop=LEFT))
    testbed.run(1.0)
    assert np.array_equal(left.backlash.at(testbed.clock.now_s()), np.zeros(2))
    testbed.command(Acquire(loop=LEFT))
    testbed.until(left=Mode.VERNIER)
    assert np.array_equal(left.observation.backlash_rad, np.zeros(2))
