"""A log through today's code: bit for bit the same, and what is told where it is not."""

import math

import msgspec
import pytest
from google.protobuf.descriptor_pool import DescriptorPool

from fitctl.config import default_rig_path, load_rig, rig_from_document, rig_from_json
from fitctl.drivers.interface import DeviceMismatch, DeviceTimeout
from fitctl.logging import schemas
from fitctl.logging.copying import cut
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info
from fitctl.logging.records import CommandRecord, FrameRecord, ModeChange, Tick
from fitctl.model.drives import Drive
from fitctl.supervisor.messages import (
    Acquire,
    Experiment,
    Hold,
    Look,
    Off,
    Recover,
    Reset,
    SetController,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.supervisor.modes import Mode
from fitctl.supervisor.replay import replay
from fitctl.supervisor.replay_log import read_steps, whole_run
from tests.logged_simulation import WALL_S, LoggedSimulation

SOON = "loops.right.coarse.reach_fraction=0.7"  # seconds less in COARSE
TIMEOUT = DeviceTimeout("device", "here", "an answer", "none", "look")
MOVED = DeviceMismatch("piezo", "here", "its limit", "another", "set it back")
SCAN = [
    Drive(channel="fsm_az", shape="triangle", amplitude=2.0, frequency_hz=1.0, duration_s=1.0),
    Drive(channel="siderostat_el", shape="sine", amplitude=2.0, frequency_hz=1.0, duration_s=1.5),
]


@pytest.fixture
def logged(tmp_path):
    """The log of what `course` does with a simulation, and the simulation."""

    def make(course, *overrides, rig=None, **options):
        rig = rig or load_rig(default_rig_path(), [SOON, *overrides])
        path = tmp_path / "run.mcap"
        simulation = LoggedSimulation(rig, path, **options)
        course(simulation)
        simulation.writer.close()
        return path, simulation

    return make


def replayed(*paths, change=()):
    with whole_run(paths) as info:
        rig = rig_from_json(info.metadata["rig"]["json"], "the log", change)
        return replay(rig, read_steps(info, list(rig.loops)))


def failing(error):
    def fail(*_args, **_kwargs):
        raise error

    return fail


# ---------------------------------------------------------------- courses


def hold_a_star(simulation):
    simulation.acquire()
    until_held(simulation)
    simulation.run(2.0)


def until_held(simulation, limit_s=20.0):
    end_s = simulation.clock.now_s() + limit_s
    loops = simulation.supervisor.loops.values()
    while not any(loop.mode is Mode.VERNIER for loop in loops):
        assert simulation.clock.now_s() < end_s
        simulation.run(0.1)


def every_command(simulation):
    hold_a_star(simulation)
    simulation.command(SetTarget(az_px=22.0, el_px=18.5))
    simulation.run(1.0)
    simulation.command(SetController(name="minimum-variance"))
    simulation.run(1.0)
    for command in (Hold(), Acquire(), Stop(), Recover(), Acquire(), Stop()):
        simulation.command(command)
        simulation.run(0.7)
    simulation.command(Off())
    simulation.run(0.1)
    simulation.command(Standby())
    simulation.run(0.3)


def another_star(simulation):
    hold_a_star(simulation)
    az_px, el_px = simulation.plants["right"].spots_px(simulation.clock.now_s())[0][1].tolist()
    assert simulation.command(Look(az_px=az_px, el_px=el_px)).accepted
    simulation.run(3.0)
    assert simulation.ticks[-1].star_flux_dn == pytest.approx(24_000, rel=0.02)


def an_experiment(simulation):
    hold_a_star(simulation)
    simulation.command(Experiment(loop="right", name="try", drives=SCAN))
    simulation.run(2.5)
    simulation.command(Experiment(loop="right", name="again", drives=SCAN))
    simulation.run(0.5)
    simulation.command(Stop())
    simulation.run(0.3)


def a_star_that_is_lost(simulation):
    hold_a_star(simulation)
    flux_dn = simulation.camera._scene._flux_dn
    simulation.camera._scene._flux_dn = 0.0 * flux_dn
    simulation.run(1.0)
    simulation.camera._scene._flux_dn = flux_dn
    simulation.run(3.0)


def nothing_that_opens(simulation):
    amplifiers = simulation.devices.loops["right"].amplifiers
    opening, amplifiers.open = amplifiers.open, failing(TIMEOUT)
    for _ in range(2):
        simulation.command(Standby())
        simulation.run(0.1)
    amplifiers.open = opening
    hold_a_star(simulation)


def _fails(part, method, error=TIMEOUT):
    """While a star is held a device fails; it recovers, and the star is held again."""

    def course(simulation):
        hold_a_star(simulation)
        devices = simulation.devices
        device = devices.camera if part == "camera" else getattr(devices.loops["right"], part)
        well = getattr(device, method)
        setattr(device, method, failing(error))
        simulation.run(2.5)
        setattr(device, method, well)
        simulation.command(Recover())
        simulation.command(Acquire())
        simulation.run(2.0)

    return course


def off_and_on_in_one_breath(simulation):
    """Without a camera no tick is logged between the two."""
    hold_a_star(simulation)
    simulation.command(Stop())
    camera = simulation.devices.camera
    well, camera.next_frame = camera.next_frame, failing(TIMEOUT)
    simulation.run(0.5)
    camera.next_frame = well
    simulation.command(Off())
    hold_a_star(simulation)


def interlocks(simulation):
    """One flattens for a while, one holds until it is reset, one makes safe."""
    hold_a_star(simulation)
    supervisor = simulation.supervisor
    for quantity, value in (
        ("disk_free_bytes", 0.0),
        ("disk_free_bytes", 1e12),
        ("recorder_backlog_fraction", 0.9),
        ("recorder_backlog_fraction", 0.0),
    ):
        supervisor.measured(quantity, value)
        simulation.run(0.5)
    assert simulation.command(Reset(name="recorder_behind")).accepted
    simulation.run(0.5)
    supervisor.measured("clock_step_s", 9.0)
    simulation.run(0.5)


INTERLOCKS = [
    "interlocks.disk_space.action=flatten",
    "interlocks.recorder_behind={ quantity = 'recorder_backlog_fraction', high = 0.5, for_s = 0.0, "
    "modes = ['VERNIER'], action = 'hold', reset = 'hand' }",
    "interlocks.clock={ quantity = 'clock_step_s', high = 1.0, for_s = 0.1, modes = ['VERNIER'], "
    "action = 'safe', reset = 'hand' }",
]
TWO_STARS = (
    "plant.loops.right.spots=[{name='a', offset_px={az=0.0, el=0.0}, flux_dn=30000.0, diameter_px=3.0}, "
    "{name='b', offset_px={az=-9.0, el=5.0}, flux_dn=24000.0, diameter_px=3.0}]"
)
FAULT = {"STAR_FOUND", "IN_REACH", "FAULT", "RECOVER"}
# What is done, with which rig, and what must have happened for it to say anything.
COURSES = {
    "every command": (every_command, [], {"HOLD", "STOP", "RECOVER", "OFF", "IN_REACH"}),
    "another star": (another_star, [TWO_STARS], {"IN_REACH"}),
    "experiments": (an_experiment, [], {"EXPERIMENT", "EXPERIMENT_DONE", "STOP"}),
    "a lost star": (a_star_that_is_lost, [], {"STAR_LOST", "STAR_FOUND", "IN_REACH"}),
    "nothing opens": (nothing_that_opens, [], {"STANDBY", "IN_REACH"}),
    "off and on": (off_and_on_in_one_breath, [], {"STOP", "OFF", "IN_REACH"}),
    "interlocks": (interlocks, INTERLOCKS, {"IN_REACH", "FAULT"}),
    "the D/A fails": (_fails("dac", "write_v"), [], FAULT),
    "the amplifiers fail": (_fails("amplifiers", "exchange"), [], FAULT),
    "the camera fails": (_fails("camera", "next_frame"), [], FAULT),
    "the piezo amplifier is silent": (_fails("piezo", "stack_volts"), [], FAULT),
    "the piezo amplifier's switch moved": (_fails("piezo", "limit_v", MOVED), [], FAULT),
}


@pytest.mark.parametrize(("course", "overrides", "happens"), COURSES.values(), ids=COURSES.keys())
def test_a_run_replayed_is_the_same_to_the_last_bit(logged, course, overrides, happens):
    path, simulation = logged(course, *overrides)
    result = replayed(path)

    assert happens <= {change.trigger for change in simulation.mode_changes}
    assert result.same, result
    loop = result.loops["right"]
    assert loop.ticks == sum(tick.number >= 0 or tick.mode != "OFF" for tick in simulation.ticks)
    assert all(found.compared >= 2 * loop.ticks for found in loop.differences.values())


def two_loops():
    document = load_rig(default_rig_path(), [SOON]).model_dump(mode="json")
    for loops in (document[part]["loops"] for part in ("plant", "mocks")):
        loops["left"] = dict(loops["right"])
    document["loops"]["left"] = document["loops"]["right"] | {
        "star_flux_dn": 84000.0,
        "target_px": {"az": 12.0, "el": 19.5},
    }
    (spot, *_) = document["plant"]["loops"]["left"]["spots"]
    document["plant"]["loops"]["left"]["spots"] = [spot | {"flux_dn": 84000.0}]
    return rig_from_document(document, "two loops")


def test_two_loops_that_do_different_things_are_replayed_together(logged):
    def course(simulation):
        simulation.command(Standby(loop="right"))
        simulation.command(Acquire(loop="right"))
        simulation.run(2.0)
        simulation.command(Standby(loop="left"))
        simulation.command(Acquire(loop="left"))
        simulation.run(4.0)
        simulation.command(Stop(loop="right"))
        simulation.run(0.5)

    path, simulation = logged(course, rig=two_loops())
    result = replayed(path)

    found = {(change.loop, change.trigger) for change in simulation.mode_changes}
    assert {("left", "IN_REACH"), ("right", "IN_REACH"), ("right", "STOP")} <= found
    assert result.same, result
    assert result.loops["left"].ticks > 200


# ---------------------------------------------------------------- where it differs


@pytest.fixture
def held(logged):
    """The log of a star that is held, and since when."""

    def make(**options):
        path, simulation = logged(hold_a_star, **options)
        (since_s,) = (c.time_s for c in simulation.mode_changes if c.target == "VERNIER")
        return path, since_s

    return make


def test_another_controller_commands_otherwise_from_its_first_tick_on(held):
    path, since_s = held()
    result = replayed(path, change=["loops.right.vernier.controller=minimum-variance"])

    loop = result.loops["right"]
    assert not result.same
    assert loop.mode.ticks == loop.differences["star_px"].ticks == 0
    stacks = loop.differences["stacks_v"]
    assert stacks.first_s == pytest.approx(since_s, abs=0.021)
    assert stacks.worst > stacks.rms > 1e-3


def test_a_mode_that_is_left_by_todays_rig_is_told_with_its_time(held):
    path, since_s = held()
    tight = (
        "interlocks.fsm_edge={ quantity = 'fsm_range_fraction', high = 1e-6, for_s = 0.5, "
        "modes = ['VERNIER'], action = 'safe', reset = 'hand' }"
    )
    mode = replayed(path, change=[tight]).loops["right"].mode

    assert (mode.then, mode.now) == ("VERNIER", "SAFE")
    assert mode.first_s == pytest.approx(since_s + 0.5, abs=0.05)
    assert mode.ticks == pytest.approx((2.0 - 0.5) * 50, abs=8)


def test_one_bit_of_one_voltage_is_told(held):
    changed = []

    def one_bit(record):
        if isinstance(record, Tick) and record.mode == "VERNIER" and not changed:
            volts = math.nextafter(record.stack2_v, 10.0)
            changed.append((record.time_s, volts - record.stack2_v))
            return msgspec.structs.replace(record, stack2_v=volts)
        return record

    path, _ = held(change=one_bit)
    found = replayed(path).loops["right"].differences["stacks_v"]

    ((time_s, bit_v),) = changed
    assert found.ticks >= 1
    assert (found.first_s, found.worst >= bit_v) == (time_s, True)
    assert found.worst < 1e-12  # whatever follows from it


def test_one_dark_frame_in_the_log_is_seen_once_and_acted_upon(held):
    def darkened(record):
        if isinstance(record, FrameRecord) and record.number == 80:
            return msgspec.structs.replace(record, data=bytes(len(record.data)))
        return record

    path, _ = held(change=darkened)
    differences = replayed(path).loops["right"].differences

    assert differences["star_px"].ticks == 1
    assert differences["star_px"].worst == 0.0  # seen there and not here: no distance
    assert differences["stacks_v"].first_s == differences["star_px"].first_s


def test_a_command_that_todays_code_refuses_is_told(logged):
    def course(simulation):
        hold_a_star(simulation)
        assert not simulation.command(Recover()).accepted

    def accepted(record):
        known = isinstance(record, CommandRecord) and record.command == "Recover"
        return msgspec.structs.replace(record, accepted=True) if known else record

    path, _ = logged(course, change=accepted)
    result = replayed(path)

    assert not result.same
    assert result.refused == ["Recover: recover means nothing in VERNIER; from here: hold, stop"]


def test_a_frame_that_is_not_in_the_log_is_counted(held):
    def without(record):
        return None if isinstance(record, FrameRecord) and record.number == 20 else record

    path, _ = held(change=without)

    assert replayed(path).loops["right"].frames_missing == 1


# ---------------------------------------------------------------- files


def test_the_files_that_a_run_was_rotated_into_are_replayed_as_one(logged, tmp_path):
    second = tmp_path / "second.mcap"

    def course(simulation):
        hold_a_star(simulation)
        simulation.go_on_in(second)
        simulation.command(SetTarget(az_px=22.0, el_px=18.5))
        simulation.run(1.0)

    first, simulation = logged(course)
    result = replayed(first, second)

    assert result.same, result
    assert (
        result.loops["right"].ticks
        > sum(tick.time_s < simulation.clock.now_s() - 0.1 for tick in simulation.ticks) - 3
    )
    with pytest.raises(LogError, match=r"midst of a run .* give all files of the run"):
        replayed(second)


def test_a_log_that_was_torn_is_replayed_up_to_there(held):
    path, _ = held()
    whole = replayed(path).loops["right"].ticks
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    result = replayed(path)

    assert result.same, result
    assert 10 < result.loops["right"].ticks < whole


def test_the_midst_of_a_run_is_refused_whether_cut_soon_or_late(logged, tmp_path):
    def course(simulation):
        hold_a_star(simulation)
        simulation.command(Stop())
        simulation.run(9.0)

    path, _ = logged(course)
    for from_s, said in ((2.0, "loop right is in VERNIER"), (11.0, "11 s after the run's start")):
        part = tmp_path / f"from {from_s}.mcap"
        cut(path, part, from_ns=round((WALL_S + from_s) * 1e9), to_ns=2**63)
        with pytest.raises(LogError, match=said):
            replayed(part)


def test_a_log_without_frames_is_refused(held, tmp_path):
    path, _ = held()
    part = tmp_path / "part.mcap"
    ticks_only = ["/fit/right/tick", "/fit/right/opened"]
    cut(path, part, from_ns=0, to_ns=2**63, topics=ticks_only)

    with pytest.raises(LogError, match=r"has no /fit/camera/frame.*topics: /fit/right"):
        replayed(part)


def test_logs_of_two_runs_are_not_taken_for_one(held, tmp_path):
    path, _ = held()
    other = tmp_path / "other.mcap"
    rig = load_rig(default_rig_path())
    LoggedSimulation(rig, other, start_s=1.0).writer.close()

    with pytest.raises(LogError, match=r"other.mcap: is of another run"):
        replayed(path, other)


def test_a_log_of_an_older_fitctl_is_refused_and_says_what_it_lacks(held, monkeypatch):
    fields = [f for f in msgspec.structs.fields(Tick) if f.required]
    old = msgspec.defstruct("Tick", [(f.name, f.type) for f in fields])
    message = schemas.message_class(old, DescriptorPool())
    monkeypatch.setitem(
        schemas.MESSAGES, Tick, lambda **values: message(**{f.name: values[f.name] for f in fields})
    )
    path, _ = held()

    assert log_info(path).counts["/fit/right/tick"] > 100
    with pytest.raises(LogError, match=r"older fitctl .* neither commands nor when voltages"):
        replayed(path)


def test_every_mode_change_of_the_log_says_where_the_motors_were(logged):
    changes = []
    logged(hold_a_star, change=lambda r: changes.append(r) or r)
    found = [record for record in changes if isinstance(record, ModeChange)]

    assert len(found) == 4
    assert not any(math.isnan(change.siderostat_az_rad) for change in found)
