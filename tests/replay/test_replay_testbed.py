"""A testbed's log: photodiodes, a link with feedforward, and the overlap of two stars."""

import math

import msgspec
import numpy as np
import pytest
from instruments.simulated import SOON, failing
from samples.replay_courses import TIMEOUT, replayed

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.errors import LogError
from fitctl.logging.records import BeamPlace, Event, MetrologyTick, ModeChange, Overlap, Tick
from fitctl.messages.commands import (
    Acquire,
    Off,
    Recover,
    Release,
    SetController,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode

pytestmark = pytest.mark.long

RIG = default_rig_path().with_name("fit-testbed.toml")
SOON_TOO = SOON.replace("right", "left")
LOOPS = {"metrology", "left", "right"}
STAR_PX = (3.0, -2.0)  # both stars are in the field from the start
DRIFT = "collector.motion.velocity_mm_s=0.5"
PLAYS = (
    "plant.loops.left.backlash_sky_arcsec=2.0",
    "loops.left.siderostat.backlash_sky_arcsec=2.0",
    "loops.left.feedforward.signal=encoders+backlash",
)


def until(simulation, limit_s=40.0, **modes):
    end_s = simulation.clock.now_s() + limit_s
    loops = simulation.supervisor.loops
    while any(loops[name].mode is not mode for name, mode in modes.items()):
        assert simulation.clock.now_s() < end_s, {name: loop.mode for name, loop in loops.items()}
        simulation.run(0.02)


def hold_all(simulation):
    simulation.acquire()
    until(simulation, metrology=Mode.LOCKED, left=Mode.VERNIER, right=Mode.VERNIER)


def hold_and_drift(simulation):
    hold_all(simulation)
    simulation.move_collector()
    simulation.run(5.0)


def laser(simulation, power):
    simulation.plant.loops["metrology"].inputs.laser[:] = power


def everything(simulation):
    """All loops hold, the collector drifts, the link is lost and comes back, all stop and recover."""
    hold_and_drift(simulation)
    assert simulation.command(SetController(loop="left", name="minimum-variance")).accepted
    simulation.run(0.5)
    laser(simulation, 0.0)
    until(simulation, limit_s=1.0, metrology=Mode.ACQUISITION)
    simulation.run(1.0)
    laser(simulation, 1.0)
    until(simulation, limit_s=15.0, metrology=Mode.LOCKED)
    until(simulation, left=Mode.VERNIER)
    simulation.run(1.0)
    simulation.command(Stop())
    simulation.run(1.0)
    simulation.command(Recover())
    simulation.run(0.5)
    simulation.command(Acquire())
    until(simulation, metrology=Mode.LOCKED)
    simulation.run(3.0)


def the_converter_fails(method):
    """While all loops hold; then it recovers."""

    def course(simulation):
        hold_all(simulation)
        photodiodes = simulation.devices.loops["metrology"].photodiodes
        well = getattr(photodiodes, method)
        setattr(photodiodes, method, failing(TIMEOUT))
        simulation.run(0.5)
        setattr(photodiodes, method, well)
        simulation.command(Recover(loop="metrology"))
        simulation.command(Acquire(loop="metrology"))
        until(simulation, metrology=Mode.LOCKED)
        simulation.run(1.0)

    return course


def the_encoders_lose_their_zero(simulation):
    hold_all(simulation)
    for command in (Stop(loop="metrology"), Off(loop="metrology")):
        assert simulation.command(command).accepted
        simulation.run(0.1)
    amplifiers = simulation.devices.loops["metrology"].amplifiers
    exchange = amplifiers.exchange

    def from_another_zero(velocity_rad_s):
        reading = exchange(velocity_rad_s)
        az_rad, el_rad = reading.position_rad
        return reading._replace(position_rad=(az_rad + 3.0, el_rad))

    amplifiers.exchange = from_another_zero
    for command in (Standby(loop="metrology"), Acquire(loop="metrology")):
        assert simulation.command(command).accepted
    until(simulation, metrology=Mode.LOCKED)
    simulation.run(3.0)


def a_search_waits_on_its_way(simulation):
    """Left is on its way to a place far away when its link is lost; later it goes on."""
    hold_all(simulation)
    simulation.command(Release(loop="left"))
    simulation.run(0.5)
    far = Acquire(loop="left", expected_az_sky_arcsec=900.0, expected_el_sky_arcsec=0.0)
    assert simulation.command(far).accepted
    simulation.run(0.1)
    laser(simulation, 0.0)
    until(simulation, limit_s=1.0, metrology=Mode.ACQUISITION)
    assert np.abs(simulation.supervisor.loops["left"].servo.position_rad).max() < 50.0
    simulation.run(2.0)
    laser(simulation, 1.0)
    until(simulation, limit_s=15.0, metrology=Mode.LOCKED)
    simulation.run(2.0)


def a_beam_of_a_killed_supervisor(simulation):
    """The search begins where a supervisor before this one had not found its beam."""
    place = BeamPlace(
        time_s=0.0,
        loop="metrology",
        search_az_rad=2.0,
        search_el_rad=-1.0,
        siderostat_az_rad=0.0,
        siderostat_el_rad=0.0,
    )
    simulation.supervisor.recall([place])
    hold_all(simulation)
    simulation.run(2.0)


COURSES = {
    "a beam of a killed supervisor": (a_beam_of_a_killed_supervisor, [], {"BEAM_FOUND"}),
    "everything": (everything, [DRIFT], {"BEAM_LOST", "BEAM_FOUND", "IN_REACH", "STOP", "RECOVER"}),
    "a search waits on its way": (a_search_waits_on_its_way, PLAYS, {"BEAM_LOST", "BEAM_FOUND"}),
    "plays": (hold_and_drift, [DRIFT, *PLAYS], {"BEAM_FOUND", "IN_REACH"}),
    "no sample can be read": (the_converter_fails("receive"), [], {"FAULT", "RECOVER"}),
    "no sample can be requested": (the_converter_fails("send_request"), [], {"FAULT", "RECOVER"}),
    "the encoders lose their zero": (the_encoders_lose_their_zero, [], {"OFF", "BEAM_FOUND"}),
}


@pytest.fixture
def testbed_log(logged):
    """The log of what a course does with the testbed, the simulation, and all records but frames."""

    def make(course, *overrides):
        records = []
        rig = load_rig(RIG, [SOON, SOON_TOO, *overrides])
        path, _ = logged(
            course, rig=rig, star_offset_px=STAR_PX, change=lambda r: records.append(r) or r
        )
        return path, records

    return make


@pytest.mark.parametrize(("course", "overrides", "happens"), COURSES.values(), ids=COURSES.keys())
def test_a_testbed_s_run_replayed_is_the_same_to_the_last_bit(
    testbed_log, course, overrides, happens
):
    path, records = testbed_log(course, *overrides)
    result = replayed(path)

    assert happens <= {record.trigger for record in records if isinstance(record, ModeChange)}
    assert result.same, result
    assert set(result.loops) == LOOPS
    for name, loop in result.loops.items():
        kind = MetrologyTick if name == "metrology" else Tick
        ticks = [record for record in records if isinstance(record, kind) and record.loop == name]
        assert loop.ticks == len(ticks) > 200
        assert all(found.compared > 0.9 * loop.ticks for found in loop.differences.values())
    overlaps = [record.visibility for record in records if isinstance(record, Overlap)]
    assert result.loops["left"].differences["visibility"].compared == len(overlaps)
    assert np.isfinite(overlaps).sum() > 50


def test_the_left_loop_waited_and_its_siderostat_moved_against_the_link_s(testbed_log):
    """What the courses above are compared by."""
    _, records = testbed_log(everything, DRIFT)
    waits = [r for r in records if isinstance(r, Event) and "waits for the link" in r.message]
    ticks = [r for r in records if isinstance(r, Tick) and r.loop == "left"]
    turned_rad = np.ptp([tick.link_az_rad for tick in ticks if tick.mode == "VERNIER"])

    assert len(waits) > 2
    assert turned_rad > 1.0
    assert all(
        math.isnan(r.link_az_rad)
        for r in records
        if getattr(r, "loop", "") == "right" and isinstance(r, Tick)
    )


def test_without_feedforward_the_left_set_points_differ_and_nothing_else_of_the_others(testbed_log):
    path, _ = testbed_log(hold_and_drift, DRIFT)
    loops = replayed(path, change=["loops.left.feedforward.gain=0.0"]).loops

    # Where left expects its candidate, whose light is taken from right's window, depends on the link.
    assert loops["right"].mode.ticks == 0
    assert all(found.ticks < 10 for found in loops["right"].differences.values())
    assert loops["right"].differences["star_px"].worst < 0.01
    assert loops["metrology"].same
    setpoint = loops["left"].differences["siderostat_setpoint_rad"]
    assert setpoint.ticks > 200
    assert setpoint.worst > setpoint.rms > 1e-4


def test_another_controller_of_the_left_loop_differs_from_its_first_tick_in_vernier(testbed_log):
    path, records = testbed_log(hold_and_drift, DRIFT)
    loops = replayed(path, change=["loops.left.vernier.controller=minimum-variance"]).loops

    (since_s,) = (
        record.time_s
        for record in records
        if isinstance(record, ModeChange) and (record.loop, record.target) == ("left", "VERNIER")
    )
    assert loops["right"].same
    assert loops["metrology"].same
    assert loops["left"].mode.ticks == loops["left"].differences["tilt_arcsec"].ticks == 0
    stacks = loops["left"].differences["stacks_v"]
    assert stacks.first_s == pytest.approx(since_s, abs=0.021)
    assert stacks.worst > stacks.rms > 1e-3


def test_another_law_of_the_metrology_loop_differs_in_its_set_points(testbed_log):
    path, _ = testbed_log(hold_and_drift, DRIFT)
    loops = replayed(path, change=["loops.metrology.hold.crossover_hz=1.0"]).loops

    assert loops["right"].same
    assert loops["metrology"].differences["beam_arcsec"].ticks == 0
    for name in ("metrology", "left"):  # left undoes what the metrology loop wants today
        setpoint = loops[name].differences["siderostat_setpoint_rad"]
        assert setpoint.worst > setpoint.rms > 0.0


def test_one_voltage_of_one_photodiode_shows_in_the_beam_s_place_and_the_set_points(logged):
    changed = []

    def more_light(record):
        if isinstance(record, MetrologyTick) and record.mode == "LOCKED" and not changed:
            changed.append(record.time_s)
            return msgspec.structs.replace(record, diode_az_plus_v=record.diode_az_plus_v + 0.1)
        return record

    rig = load_rig(RIG, [SOON, SOON_TOO])
    path, _ = logged(hold_all, rig=rig, star_offset_px=STAR_PX, change=more_light)
    metrology = replayed(path).loops["metrology"]

    assert metrology.mode.ticks == 0
    assert metrology.differences["beam_arcsec"].ticks == 1
    assert metrology.differences["beam_arcsec"].first_s == changed[0]
    assert metrology.differences["siderostat_setpoint_rad"].first_s == changed[0]


@pytest.mark.long
def test_a_frame_whose_stellar_ticks_were_lost_is_passed_over(logged):
    def without_one_frames(record):
        return None if isinstance(record, Tick) and record.number == 100 else record

    rig = load_rig(RIG, [SOON, SOON_TOO])
    path, _ = logged(hold_all, rig=rig, star_offset_px=STAR_PX, change=without_one_frames)
    loops = replayed(path).loops

    assert loops["right"].ticks == loops["left"].ticks == loops["metrology"].ticks - 1


def test_a_log_of_a_fitctl_before_links_were_logged_is_refused(logged, monkeypatch):
    from google.protobuf.descriptor_pool import DescriptorPool

    from fitctl.logging import schemas

    fields = [f for f in msgspec.structs.fields(MetrologyTick) if f.name != "requested_s"]
    old = msgspec.defstruct("MetrologyTick", [(f.name, f.type) for f in fields])
    message = schemas.message_class(old, DescriptorPool())
    monkeypatch.setitem(
        schemas.MESSAGES,
        MetrologyTick,
        lambda **values: message(**{f.name: values[f.name] for f in fields}),
    )
    rig = load_rig(RIG)
    path, _ = logged(lambda simulation: simulation.acquire(), rig=rig)

    with pytest.raises(LogError, match=r"older fitctl .* neither when samples were requested"):
        replayed(path)
