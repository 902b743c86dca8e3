"""Devices of the swarm whose line is well and whose values are wrong."""

from functools import partial
from itertools import pairwise
from random import Random

import numpy as np
import pytest

from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.devices.hexapod import SwarmHexapod
from benchmarks.swarm.devices.mirror import SwarmDac, SwarmPiezo
from benchmarks.swarm.devices.sensors import SwarmCamera, SwarmPhotodiodes
from benchmarks.swarm.happenings import Order, Plan, Strike, kind_of
from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.lines import WRONG, Line
from benchmarks.swarm.run import run_plan
from fitctl.config import load_rig
from fitctl.drivers.interface import DeviceFault, DeviceMismatch, DeviceRefused, Pose
from fitctl.logging.records import Event, ModeChange
from fitctl.messages.commands import MoveCollector
from fitctl.model.plant import Plant
from fitctl.simulation.devices import SimulatedMirror

RIG = load_rig(FOLDER / "fit-testbed.toml")


@pytest.fixture
def plant():
    return Plant(RIG, [1], history_s=20.0)


@pytest.fixture
def does(time):
    """Does something in a thread of virtual time, which may wait; returns what that gave or raised."""

    def does(action):
        given = []

        def thread():
            try:
                given.append(action())
            except Exception as error:
                given.append(error)

        time.spawn(thread, "does")
        while not given:
            time.run_until(time.now_s() + 0.01)
        return given[0]

    return does


@pytest.fixture
def camera(time, plant, does):
    camera = SwarmCamera(RIG, time, plant, Random(1))
    does(camera.open)
    does(camera.start)
    return camera


def frames(camera, count=40):
    return [camera.next_frame(0.1) for _ in range(count)]


def test_a_frozen_camera_repeats_its_newest_image_in_new_frames(camera, does):
    (before,) = does(partial(frames, camera, 1))
    camera.line.wrong["frozen"] = 0.0
    frozen = does(partial(frames, camera))
    camera.line.heal()
    (after,) = does(partial(frames, camera, 1))

    assert all((frame.image == before.image).all() for frame in frozen)
    assert all(later.number == sooner.number + 1 for sooner, later in pairwise(frozen))
    assert (after.image != before.image).any()


def test_a_camera_that_drops_frames_counts_them(camera, does):
    camera.line.wrong["drops"] = 0.0
    got = does(partial(frames, camera))
    numbers = [frame.number for frame in got if frame is not None]
    skipped = numbers[-1] - len(numbers)

    assert 15 < skipped < 80
    assert camera.counts().lost == skipped


def test_a_saturated_camera_has_all_pixels_at_full_scale(camera, does):
    camera.line.wrong["saturated"] = 0.0

    assert (does(partial(frames, camera, 1))[0].image == 65535).all()


@pytest.fixture
def amplifiers(time, plant, does):
    def ignore(*_):
        pass

    amplifiers = SwarmAmplifiers(
        plant.loops["right"], time, RIG, "right", Random(1), ignore, ignore, ignore
    )
    does(amplifiers.open)
    does(amplifiers.enable)
    return amplifiers


def turned_rad(amplifiers, does):
    def turn():
        for _ in range(50):
            reading = amplifiers.exchange((5.0, 0.0))
        return reading

    return does(turn).position_rad[0]


def test_motors_that_are_stuck_do_not_move_until_they_come_free(amplifiers, does):
    amplifiers.line.wrong["stuck"] = 0.0
    assert turned_rad(amplifiers, does) == 0.0
    amplifiers.line.heal()

    assert turned_rad(amplifiers, does) > 0.05


@pytest.mark.parametrize(("size", "too_much_rad"), [(1.5, (1.5, 0.0)), (-1.5, (0.0, -1.5))])
def test_an_encoder_that_is_wrong_reads_another_angle_and_the_motor_stays_where_it_is(
    amplifiers, does, size, too_much_rad
):
    def read_rad():
        return does(partial(amplifiers.exchange, (0.0, 0.0))).position_rad

    right_rad = read_rad()
    amplifiers.line.begin("encoder", 60.0, size)
    wrong_rad = read_rad()
    amplifiers.line.heal()

    assert wrong_rad == pytest.approx(np.add(right_rad, too_much_rad))
    assert read_rad() == right_rad


def test_amplifiers_that_trip_have_no_power_until_their_fault_is_reset(amplifiers, does):
    amplifiers.trip()

    assert not amplifiers.powered
    assert isinstance(does(amplifiers.enable), DeviceFault)
    does(amplifiers.reset_fault)
    does(amplifiers.enable)
    assert amplifiers.powered


def test_a_piezo_amplifier_has_a_stack_at_its_limit_or_another_limit(time, plant, does):
    mirror = SimulatedMirror(plant.loops["right"], time, RIG, "right")
    piezo = SwarmPiezo(mirror, time, RIG, "right", Random(1))
    does(piezo.open)
    volts = does(piezo.stack_volts)
    piezo.line.wrong["stuck"] = 1.0

    assert does(piezo.stack_volts).tolist() == [volts[0], does(piezo.limit_v), volts[2]]
    piezo.line.wrong["limit"] = 0.0
    assert isinstance(does(piezo.limit_v), DeviceMismatch)


def test_a_dac_whose_watchdog_has_tripped_is_at_its_safe_voltages_and_refuses(time, plant, does):
    mirror = SimulatedMirror(plant.loops["right"], time, RIG, "right")
    dac = SwarmDac(
        mirror, time, RIG, "right", Random(1), lambda *_written: None, lambda _name: None
    )
    does(dac.open)
    wanted_v = np.array([1.0, 2.0, 3.0])

    def write():
        dac.send_v(wanted_v)
        dac.confirm()

    does(write)
    assert does(dac.read_v) == pytest.approx(wanted_v, abs=0.001)
    dac.line.wrong["tripped"] = 0.0

    assert isinstance(does(write), DeviceRefused)
    assert isinstance(does(dac.read_v), DeviceRefused)
    assert mirror.read_v() == pytest.approx(5.0, abs=0.001)
    dac.line.heal("tripped")
    assert does(dac.read_v) == pytest.approx(5.0, abs=0.001)


@pytest.fixture
def hexapod(time, plant, does):
    hexapod = SwarmHexapod(plant, time, RIG, Random(1))
    does(hexapod.open)
    does(hexapod.reference)
    return hexapod


FAR = Pose(5.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_hexapod_reports_another_x(hexapod, does):
    hexapod.line.wrong["offset"] = 0.0

    assert does(hexapod.pose).pose.x_mm == 1.0


def test_a_stuck_hexapod_accepts_a_move_and_does_not_move(hexapod, does):
    hexapod.line.wrong["stuck"] = 0.0

    assert does(partial(hexapod.move_to, FAR, 1.0)) is None
    assert not hexapod.moves


def test_a_hexapod_without_servos_brakes_and_refuses_to_move(hexapod, does, time):
    does(partial(hexapod.move_to, FAR, 1.0))
    hexapod.line.wrong["servos off"] = 0.0

    assert not does(hexapod.pose).servos_on
    time.run_until(time.now_s() + 0.5)
    assert not hexapod.moves
    assert does(hexapod.pose).pose.x_mm < 1.0
    assert isinstance(does(partial(hexapod.move_to, FAR, 1.0)), DeviceRefused)


def test_photodiodes_are_at_the_end_of_their_range(time, plant, does):
    photodiodes = SwarmPhotodiodes(plant.loops["metrology"], time, RIG, "metrology", Random(1))
    does(photodiodes.open)
    photodiodes.line.wrong["saturated"] = 0.0
    photodiodes.send_request()
    time.run_until(time.now_s() + 0.1)
    sensor = RIG.metrology_loops["metrology"].sensor

    volts = photodiodes.receive().volts
    assert volts == (sensor.device.range_v,) * 4
    assert min(volts) >= sensor.saturated_v


def test_a_photodiode_that_is_loose_reads_nothing_and_the_others_what_they_see(time, plant, does):
    photodiodes = SwarmPhotodiodes(plant.loops["metrology"], time, RIG, "metrology", Random(1))
    does(photodiodes.open)
    photodiodes.line.begin("loose", 60.0, size=2.0)
    photodiodes.send_request()
    time.run_until(time.now_s() + 0.1)

    volts = photodiodes.receive().volts
    assert volts[2] == 0.0
    assert np.count_nonzero(volts) == 3


def test_photodiodes_that_refuse_a_request_say_so(time, plant, does):
    photodiodes = SwarmPhotodiodes(plant.loops["metrology"], time, RIG, "metrology", Random(1))
    does(photodiodes.open)
    photodiodes.line.begin("refuses", 60.0)
    photodiodes.send_request()

    with pytest.raises(DeviceRefused):
        photodiodes.receive()


# ------------------------------------------------------------ whole runs


def run_without_violation(rig, duration_s, happenings):
    """The records of a run in which nothing is violated."""
    records = []
    plan = Plan(seed=1, rig=rig, settings=[], duration_s=duration_s, happenings=happenings)
    assert run_plan(plan, records.append).violations == []
    return records


@pytest.mark.long
@pytest.mark.parametrize(
    ("device", "fault", "size", "reason"),
    [
        ("right siderostat", "trip", 0.0, "overcurrent"),
        ("right siderostat", "stuck", 0.0, "following error"),
        ("right siderostat", "encoder", 3.0, "following error"),
        ("right piezo", "stuck", 1.0, "stack 2"),
        ("right piezo", "limit", 0.0, "its limit"),
        ("right D/A", "tripped", 0.0, "a refusal"),
    ],
)
def test_a_wrong_value_leads_to_safe_and_violates_nothing(device, fault, size, reason):
    happenings = [
        Order(at_s=0.1, who="ada"),
        Order(at_s=2.0, who="ada"),  # the search moves the siderostat
        Strike(at_s=2.5, device=device, fault=fault, lasts_s=4.0, size=size),
    ]
    records = run_without_violation("fit-mock.toml", 8.0, happenings)
    reasons = [
        record.reason
        for record in records
        if isinstance(record, ModeChange) and record.target == "SAFE"
    ]

    assert reason in reasons[0]


@pytest.mark.long
@pytest.mark.parametrize("device", ["camera", "metrology photodiodes"])
def test_a_sensor_with_wrong_values_violates_nothing(device):
    happenings = [
        *[Order(at_s=at_s, who="ada") for at_s in (0.1, 2.0, 4.0)],
        *[
            Strike(at_s=25.0 + 14.0 * number, device=device, fault=fault, lasts_s=9.0)
            for number, fault in enumerate(WRONG[kind_of(device)])
        ],
    ]

    run_without_violation("fit-testbed.toml", 70.0, happenings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "reported"),
    [("offset", "of its course"), ("stuck", "of its course"), ("servos off", "servos that are on")],
)
def test_a_hexapod_that_goes_wrong_under_way_violates_nothing(fault, reported):
    happenings = [
        Order(at_s=0.1, who="ada"),
        Order(at_s=2.0, who="ada", command=MoveCollector(action="reference")),
        Order(at_s=12.0, who="ada", command=MoveCollector(action="start")),
        Strike(at_s=14.0, device="hexapod", fault=fault, lasts_s=9.0),
    ]
    records = run_without_violation("fit-testbed.toml", 30.0, happenings)
    errors = [
        record.message
        for record in records
        if isinstance(record, Event) and record.severity == "error"
    ]

    assert len(errors) == 1
    assert reported in errors[0]


# ------------------------------------------------------------ how long a fault lasts, and which calls it meets


def test_a_fault_is_not_cut_short_by_an_earlier_one_of_its_kind(time):
    line = Line("D/A", "", time, Random(1), 0.001, 0.1)
    line.begin("mute", 2.0)
    time.run_until(1.0)
    line.begin("mute", 3.0)

    time.run_until(3.9)
    assert "mute" in line.faults
    time.run_until(4.1)
    assert line.faults == {}


def test_a_fault_of_some_calls_meets_that_fraction_of_them(time, does):
    line = Line("D/A", "", time, Random(1), 0.001, 0.1)
    line.open()
    line.begin("refuses", 60.0, part=0.2)
    answers = [does(lambda: line.ask(lambda: "done")) for _ in range(500)]

    refused = sum(isinstance(answer, DeviceRefused) for answer in answers)
    assert answers.count("done") + refused == 500
    assert 60 <= refused <= 140  # 100 are expected, with a standard deviation of 9
    assert line.is_bad
    assert not line.is_silent
    line.heal()
    assert not line.is_bad


def test_a_fault_may_meet_a_single_call(time, does):
    line = Line("D/A", "", time, Random(1), 0.001, 0.1)
    line.open()
    line.begin("refuses", 60.0, number=3)
    answers = [does(lambda: line.ask(lambda: "done")) for _ in range(10)]

    assert [type(answer) for answer in answers] == [*[str] * 2, DeviceRefused, *[str] * 7]
    assert line.is_readable


def test_a_fault_of_all_calls_does_not_last_as_long_as_one_of_some(time):
    line = Line("D/A", "", time, Random(1), 0.001, 0.1)
    line.begin("mute", 20.0, part=0.01)
    line.begin("mute", 0.05)

    time.run_until(0.1)
    assert line.faults == {}
    assert line.at_times.keys() == {"mute"}
    time.run_until(20.1)
    assert not line.is_bad


def test_a_wrong_value_may_be_that_of_some_answers(time, plant, does):
    piezo = SwarmPiezo(
        SimulatedMirror(plant.loops["right"], time, RIG, "right"), time, RIG, "right", Random(1)
    )
    piezo.line.open()
    piezo.line.begin("limit", 1000.0, part=0.2)
    answers = [does(piezo.limit_v) for _ in range(300)]

    wrong = sum(isinstance(answer, DeviceMismatch) for answer in answers)
    assert 30 <= wrong <= 90  # 60 are expected, with a standard deviation of 7
    assert piezo.line.wrong == {}
