"""The collector under the supervisor: commanded beside the ticks, stopped by STOP, faults as events."""

import threading
import time
from types import SimpleNamespace

import pytest
from instruments.c887_settings import MOCK, device
from serial.urlhandler import protocol_socket

from fitctl.clock import MonotonicClock
from fitctl.config import ConfigError, Fault, default_rig_path, load_rig
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.interface import DeviceTimeout
from fitctl.messages.commands import MoveCollector, Off, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.mocks.c887.server import C887ControllerMock
from fitctl.simulation.simulation import Simulation
from fitctl.stages.periodic import PeriodicThread
from fitctl.supervisor.collector import CollectorWatch
from fitctl.supervisor.health import hexapod_health

RIG = load_rig(
    default_rig_path().parent / "fit-testbed.toml",
    ["collector.motion.kind=drift", "collector.motion.velocity_mm_s=2.0"],
)
PATIENCE_S = 10.0
RESPONSE_TIMEOUT_S = 0.5


@pytest.fixture
def watched(in_loop, monkeypatch):
    """A watch and the mock that it moves, in real time; `events` are those reported."""
    # pyserial sleeps 0.3 s after closing a socket, for servers that are slow to accept again.
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda _seconds: None))

    async def made():
        mock = C887ControllerMock(MOCK.model_copy(update={"referenced": False, "reference_s": 1.0}))
        return mock, await mock.start()

    async def struck(kind):
        mock.faults.set(Fault(device="hexapod", kind=kind)) if kind else mock.faults.clear()

    mock, ends = in_loop(made())
    clock, events = MonotonicClock(), []

    def report(*event):
        events.append(event)
        print(event)  # pytest shows it with a test that fails

    settings = device(f"socket://127.0.0.1:{ends.tcp_port}", response_timeout_s=RESPONSE_TIMEOUT_S)
    watch = CollectorWatch(RIG.collector, C887Hexapod(settings), clock, report)
    watch.events = events
    watch.strike = lambda kind: in_loop(struck(kind))
    thread = PeriodicThread(watch.drive, clock)
    thread.start()
    yield watch, mock
    thread.stop()
    watch.close()
    in_loop(mock.stop())


def until(holds, what):
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s, what
        time.sleep(0.01)


def reported(watch, text):
    until(lambda: any(text in message for _, _, message in watch.events), f"{text} in an event")


def y_mm(mock):
    return mock.pose_at(time.monotonic())[1]


def moving(watch, mock):
    """Reference it and let it drift."""
    assert watch.obey(MoveCollector(action="reference")) == ""
    reported(watch, "referenced")
    assert watch.obey(MoveCollector(action="start")) == ""
    until(lambda: y_mm(mock) > 0.5, "a drift")


def test_it_is_connected_when_it_is_first_needed_and_moves_only_on_command(watched):
    watch, mock = watched
    assert not watch.is_open
    moving(watch, mock)
    assert watch.identity.model == "C-887 with M-850.H11"
    assert watch.detail.startswith("drift at +")
    assert watch.obey(MoveCollector(action="start")) == "the collector moves; stop it first"


def test_servos_that_are_off_are_reported_before_anything_is_said_to_move(watched):
    watch, mock = watched
    moving(watch, mock)
    watch.strike("servo_off")
    until(lambda: not watch.drive.running, "the end of the course")
    watch.strike("")
    del watch.events[:]

    assert watch.obey(MoveCollector(action="start")) == ""
    until(lambda: watch.events, "how the start ends")
    [(severity, _, message)] = watch.events
    assert severity == "error"
    assert "expected all servos on" in message
    assert "reference it first" in message

    moving(watch, mock)


def test_a_motion_of_the_command_s_own_replaces_the_rig_s_once(watched):
    watch, mock = watched
    assert watch.obey(MoveCollector(action="reference")) == ""
    reported(watch, "referenced")
    until(lambda: not watch.state.busy, "the end of the reference move")
    across = {"kind": "sine", "direction_deg": 90.0, "amplitude_mm": 1.0, "frequency_hz": 0.5}
    assert watch.obey(MoveCollector(action="start", **across)) == ""
    until(lambda: abs(mock.pose_at(time.monotonic())[2]) > 0.5, "a sine in elevation")
    assert abs(y_mm(mock)) < 0.01
    assert watch.state.motion == "sine"
    watch.stop()
    until(lambda: not watch.state.busy, "the end of the stop")
    assert watch.state.motion == ""
    assert watch.obey(MoveCollector(action="start")) == ""
    until(lambda: watch.state.motion == "drift", "the rig's own motion")


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (MoveCollector(action="start", amplitude_mm=-1.0), "amplitude_mm: must be greater than 0"),
        (MoveCollector(action="start", direction_deg=float("nan")), "direction_deg: must be"),
        (MoveCollector(action="start", kind="file"), "file must name a CSV file"),
        (MoveCollector(action="start", velocity_mm_s=900.0), "the motion reaches 900 mm/s"),
        (
            MoveCollector(action="start", range_mm=1e3),
            "mm from end to end; collector.hexapod.travel",
        ),
        (MoveCollector(action="start", kind="sine", range_mm=1.0), "sine has no range_mm; it has"),
        (MoveCollector(action="stop", kind="sine"), "stop has no motion; kind belong to start"),
    ],
)
def test_a_motion_that_is_none_is_refused_at_once(watched, command, answer):
    watch, _ = watched
    assert answer in watch.obey(command)
    assert not watch.is_open


def test_a_course_that_goes_too_far_from_where_it_stands_is_refused_before_anything_moves(watched):
    watch, mock = watched
    moving(watch, mock)
    watch.stop()
    until(lambda: not watch.state.busy, "the end of the stop")
    stands_mm = y_mm(mock)
    _, far_mm = RIG.collector.hexapod.travel.ends[1]
    assert watch.obey(MoveCollector(action="start", kind="drift", range_mm=far_mm)) == ""
    reported(watch, "a course with ")
    assert (watch.state.motion, y_mm(mock)) == ("", stands_mm)


def test_it_is_not_moved_before_it_is_referenced(watched):
    watch, mock = watched
    assert watch.obey(MoveCollector(action="start")) == ""
    reported(watch, "reference it first")
    assert not watch.drive.running
    assert y_mm(mock) == 0.0
    assert watch.is_open, "a refusal does not end the connection"


class Meanwhile:
    """Stands for a thread of the watch: while that looks whether it is alive, another stop comes."""

    def __init__(self, stop):
        self.other = threading.Thread(target=stop)
        self.asked = False

    def is_alive(self):
        if not self.asked:
            self.asked = True
            self.other.start()
            self.other.join(0.2)
        return True


def test_of_two_stops_at_once_neither_is_forgotten(watched):
    watch, mock = watched
    moving(watch, mock)
    meanwhile = Meanwhile(watch.stop)
    watch._threads = [meanwhile]
    watch.stop()
    meanwhile.other.join(PATIENCE_S)

    assert len(watch._threads) == 3  # close waits for these
    watch._threads.remove(meanwhile)
    until(lambda: not watch.state.busy, "the end of both stops")


def test_a_stop_returns_without_waiting_for_the_hexapod(watched):
    watch, mock = watched
    moving(watch, mock)
    watch.strike("freeze")
    started_s = time.monotonic()
    watch.stop()
    assert time.monotonic() - started_s < 0.5 * RESPONSE_TIMEOUT_S


def test_a_stop_leaves_it_where_it_is(watched):
    watch, mock = watched
    moving(watch, mock)
    watch.stop()
    reported(watch, "was stopped where it is")
    here = y_mm(mock)
    time.sleep(0.2)
    assert y_mm(mock) == here > 0.5
    assert watch.obey(MoveCollector(action="start")) == ""
    until(lambda: y_mm(mock) > here + 0.2, "a new start from there")


def test_no_motion_is_begun_while_a_stop_is_under_way(watched, monkeypatch):
    watch, mock = watched
    moving(watch, mock)
    ended, stop = threading.Event(), watch.drive.stop

    def slow_stop():
        stop()
        ended.wait(PATIENCE_S)

    monkeypatch.setattr(watch.drive, "stop", slow_stop)
    watch.stop()
    until(lambda: not watch.drive.running, "the end of the course")
    assert "is being stopped" in watch.obey(MoveCollector(action="start"))
    ended.set()
    reported(watch, "was stopped where it is")
    until(lambda: watch.obey(MoveCollector(action="start")) == "", "the next motion")
    until(lambda: watch.state.motion == "drift", "a drift")


def test_a_start_that_a_stop_overtakes_says_that_nothing_moves(watched, monkeypatch):
    watch, mock = watched
    opened = watch._hexapod.open

    def slow_open():
        identity = opened()
        watch.stop()
        return identity

    monkeypatch.setattr(watch._hexapod, "open", slow_open)
    assert watch.obey(MoveCollector(action="reference")) == ""
    reported(watch, "nothing began to move: a stop came first")
    assert y_mm(mock) == 0.0


def test_a_stop_ends_a_reference_move(watched):
    watch, _ = watched
    watch.obey(MoveCollector(action="reference"))
    until(lambda: watch.is_open, "a connection")
    time.sleep(0.2)
    assert "wait for the event" in watch.obey(MoveCollector(action="start"))
    watch.stop()
    reported(watch, "all axes referenced")
    assert watch.error
    # The reference move may have reported its end before the stop has: a thread of its own checks that.
    until(lambda: not watch._stopping, "the end of the stop")
    assert watch.obey(MoveCollector(action="reference")) == ""
    reported(watch, "referenced: all axes are at zero")
    assert not watch.error


def test_a_reference_move_that_begins_just_after_a_stop_is_stopped(watched, monkeypatch):
    watch, mock = watched
    reference = watch._hexapod.reference

    def after_a_stop(is_wanted):
        watch.stop()
        until(lambda: not watch._stopping, "the end of the stop")
        reference(is_wanted)

    monkeypatch.setattr(watch._hexapod, "reference", after_a_stop)
    watch.obey(MoveCollector(action="reference"))
    reported(watch, "all axes referenced")

    assert not mock.platform.referenced


def test_a_watch_that_is_closed_ends_a_reference_move(watched):
    watch, mock = watched
    watch.obey(MoveCollector(action="reference"))
    until(lambda: mock.platform.referencing, "a reference move")
    watch.close()

    assert not mock.platform.referencing
    assert not mock.platform.referenced


@pytest.mark.parametrize("kind", ["motion_error", "emergency_stop", "disconnect", "silent"])
def test_a_fault_on_the_way_is_an_event_and_the_collector_is_no_longer_moved(watched, kind):
    watch, mock = watched
    moving(watch, mock)
    watch.strike(kind)
    until(lambda: not watch.drive.running, "the end of the course")
    watch.check()
    assert [severity for severity, _, _ in watch.events][-1] == "error"
    assert watch.error
    assert hexapod_health(watch, 0.0).state == "fault"
    assert watch.is_open == (kind in {"motion_error", "emergency_stop"})


def drifting():
    """A simulation whose collector has moved for two seconds."""
    simulation = Simulation(RIG, seed=1)
    assert simulation.command(Standby()).accepted
    simulation.run(0.2)
    simulation.move_collector()
    simulation.run(2.0)
    return simulation


def test_the_supervisor_s_stop_stops_the_collector():
    simulation = drifting()
    assert simulation.hexapod.pose().pose.y_mm > 1.0
    assert simulation.command(Stop()).accepted
    simulation.run(0.5)
    here = simulation.hexapod.pose()
    assert not here.moving
    simulation.run(0.5)
    assert simulation.hexapod.pose().pose == here.pose
    assert not simulation.supervisor.collector.drive.running


def test_off_for_the_last_loop_stops_the_collector():
    simulation = drifting()
    for number, name in enumerate(simulation.supervisor.loops, start=1):
        assert simulation.command(Off(loop=name)).accepted
        simulation.run(0.5)
        is_last = number == len(simulation.supervisor.loops)
        assert simulation.supervisor.collector.drive.running != is_last
    assert not simulation.hexapod.pose().moving


def unanswered(*_arguments, **_settings):
    raise DeviceTimeout("device", "here", "an answer", "none")


@pytest.mark.parametrize("device", ["siderostat", "piezo amplifier", "camera"])
@pytest.mark.long
def test_the_collector_stops_when_a_device_takes_a_loop_to_safe(monkeypatch, device):
    simulation = drifting()
    right = simulation.devices.loops["right"]
    owner, call = {
        "siderostat": (right.amplifiers, "exchange"),
        "piezo amplifier": (right.piezo, "stack_volts"),
        "camera": (simulation.camera, "next_frame"),
    }[device]
    monkeypatch.setattr(owner, call, unanswered)
    for _ in range(500):
        simulation.supervisor.step()

    assert simulation.supervisor.loops["right"].mode is Mode.SAFE
    assert not simulation.supervisor.collector.drive.running
    assert not simulation.hexapod.pose().moving


def test_a_supervisor_that_ends_leaves_no_collector_moving():
    simulation = drifting()
    assert simulation.hexapod.pose().moving
    simulation.supervisor.close()
    assert not simulation.supervisor.collector.drive.running


def test_a_rig_without_a_collector_refuses_the_command(simulate_with):
    reply = simulate_with().command(MoveCollector(action="start"))
    assert (reply.accepted, reply.text) == (False, "the rig has no collector that moves")


def test_a_course_that_cannot_be_read_is_reported_in_its_own_words(watched, monkeypatch):
    watch, _ = watched
    why = "collector.motion.file: gone.csv: cannot be read"

    def unreadable(_motion):
        raise ConfigError(why)

    monkeypatch.setattr(watch.drive, "start", unreadable)
    assert watch.obey(MoveCollector(action="start")) == ""

    reported(watch, why)
    assert watch.error == why


def test_a_stop_for_a_loop_that_the_rig_does_not_have_is_refused_and_stops_nothing():
    simulation = drifting()

    reply = simulation.command(Stop(loop="nobody"))
    simulation.run(0.5)

    assert "no loop is named nobody" in reply.text
    assert simulation.supervisor.collector.drive.running
