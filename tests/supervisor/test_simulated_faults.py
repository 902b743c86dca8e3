"""What the supervisor does about devices that fail, on the virtual clock with the full plant."""

import numpy as np
import pytest
from instruments.simulated import SlowExecutor, events_of, failing, mode_of, until

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceTimeout, DeviceUnreachable
from fitctl.logging.records import (
    CommandRecord,
    DeviceHealth,
    FrameRecord,
    ModeChange,
    PiezoReading,
    Tick,
)
from fitctl.messages.commands import (
    Acquire,
    Off,
    Recover,
    Release,
    SetBiasOffset,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.simulation.devices import InlineExecutor
from fitctl.simulation.simulation import Simulation

FAULTS = {
    "camera": ("camera", "next_frame"),
    "D/A": ("dac", "confirm"),
    "piezo": ("piezo", "stack_volts"),
    "siderostat": ("amplifiers", "exchange"),
}


def test_a_fault_in_safe_is_told_once(vernier, monkeypatch):
    vernier.command(Stop())
    error = DeviceTimeout("piezo", "/dev/ttyUSB0", "an answer", "none")
    piezo = vernier.devices.loops["right"].piezo
    monkeypatch.setattr(piezo, "stack_volts", failing(error))
    vernier.run(5.0)

    told = [event for event in events_of(vernier) if "/dev/ttyUSB0" in event.message]
    assert [event.severity for event in told] == ["warning", "error"]


def test_one_bad_answer_of_the_piezo_amplifier_is_asked_for_again(vernier, monkeypatch):
    piezo = vernier.devices.loops["right"].piezo
    answers = iter([failing(DeviceTimeout("piezo", "/dev/ttyUSB0", "an answer", "none"))])
    measured = piezo.stack_volts

    def once_bad():
        return next(answers, measured)()

    monkeypatch.setattr(piezo, "stack_volts", once_bad)
    vernier.run(5.0)

    assert vernier.supervisor.loops["right"].mode is Mode.VERNIER
    told = [event for event in events_of(vernier) if "/dev/ttyUSB0" in event.message]
    assert [event.severity for event in told] == ["warning"]


class LateExecutor(InlineExecutor):
    """Device work takes no time, but that it is done is known half a second later."""

    def __init__(self, clock):
        self._clock = clock

    def submit(self, fn, /, *args, **kwargs):
        future, known_s = super().submit(fn, *args, **kwargs), self._clock.now_s() + 0.5
        future.done = lambda: self._clock.now_s() >= known_s
        return future


def test_amplifiers_keep_their_power_however_long_the_recovery_from_safe_takes(
    vernier, monkeypatch
):
    vernier.command(Stop())
    vernier.run(2 * vernier.rig.supervisor.safe_disable_after_s)
    assert not vernier.supervisor.servos["right"].enabled

    monkeypatch.setattr(vernier.supervisor._device_jobs, "_executor", LateExecutor(vernier.clock))
    vernier.command(Recover())
    until(vernier, Mode.STANDBY, limit_s=1.0)
    vernier.run(1.0)

    assert vernier.supervisor.servos["right"].enabled
    vernier.command(Acquire())
    until(vernier, Mode.VERNIER)


@pytest.mark.long
def test_a_siderostat_that_does_not_come_to_where_the_search_begins_is_told(vernier, monkeypatch):
    vernier.command(Release())
    vernier.supervisor.servos["right"].stop()
    vernier.command(Acquire(expected_az_sky_arcsec=400.0, expected_el_sky_arcsec=0.0))
    until(vernier, Mode.STANDBY, limit_s=60.0)

    assert "did not reach the start of the search" in events_of(vernier)[-1].message


@pytest.mark.parametrize("stack", [0, 1, 2])
def test_a_stack_that_is_not_where_it_was_told_makes_the_loop_safe(vernier, monkeypatch, stack):
    piezo = vernier.devices.loops["right"].piezo
    measured = piezo.stack_volts

    def saturated():
        volts = measured()
        volts[stack] = 150.0
        return volts

    monkeypatch.setattr(piezo, "stack_volts", saturated)
    until(vernier, Mode.SAFE, limit_s=1.5)

    assert f"expected stack {stack + 1} within 5 V of" in events_of(vernier)[-1].message
    assert "got 150.0 V" in events_of(vernier)[-1].message


def test_closing_that_fails_as_a_whole_is_an_event(vernier, monkeypatch):
    monkeypatch.setattr("fitctl.supervisor.device_jobs.close_devices", failing(OSError("boom")))
    vernier.command(Stop())
    vernier.run(1.0)
    vernier.command(Off())
    vernier.run(0.1)

    assert any("closing devices failed: " in e.message for e in events_of(vernier))
    monkeypatch.undo()


def test_a_device_that_cannot_be_closed_keeps_no_other_from_being_closed(vernier, monkeypatch):
    devices = vernier.devices
    closed = []
    monkeypatch.setattr(devices.loops["right"].piezo, "close", failing(OSError("stuck")))
    monkeypatch.setattr(devices.camera, "close", lambda: closed.append("camera"))
    vernier.command(Stop())
    vernier.run(1.0)
    assert vernier.command(Off()).accepted
    vernier.run(0.1)

    assert closed == ["camera"]
    assert any("right piezo did not close well" in e.message for e in events_of(vernier))


def test_an_error_that_is_no_devices_leads_to_safe_and_not_to_a_crash(vernier, monkeypatch):
    amplifiers = vernier.devices.loops["right"].amplifiers
    monkeypatch.setattr(amplifiers, "exchange", failing(KeyError("nobody knows")))

    until(vernier, Mode.SAFE, limit_s=0.5)

    assert any("nobody knows" in event.message for event in events_of(vernier))


def test_encoders_that_count_anew_make_the_old_place_of_the_star_forgotten(vernier):
    vernier.command(Release())
    vernier.command(Off())
    vernier.run(0.1)
    vernier.plants["right"].state.motor_rad[:] += 30.0
    vernier.plants["right"].state.beam_motor_rad[:] += 30.0
    vernier.command(Standby())
    vernier.run(0.5)

    assert any("forgotten" in event.message for event in events_of(vernier))
    before = vernier.supervisor.servos["right"].position_rad.copy()
    vernier.command(Acquire())
    vernier.run(0.2)
    assert np.all(np.abs(vernier.supervisor.servos["right"].position_rad - before) < 4.0)


@pytest.mark.parametrize("device", FAULTS)
def test_a_fault_of_any_device_leads_to_safe_with_an_event_that_names_it(
    vernier, monkeypatch, device
):
    part, method = FAULTS[device]
    devices = vernier.devices
    target = devices.camera if part == "camera" else getattr(devices.loops["right"], part)
    error = DeviceUnreachable(device, "127.0.0.1:1", "an answer", "nothing", "look at the cable")
    monkeypatch.setattr(target, method, failing(error))

    until(vernier, Mode.SAFE, limit_s=1.5)

    message = events_of(vernier)[-1].message
    assert device in message
    assert "look at the cable" in message
    assert events_of(vernier)[-1].severity == "error"


def test_a_frame_that_does_not_come_is_a_fault_in_time(vernier, monkeypatch):
    clock, camera = vernier.clock, vernier.devices.camera

    def nothing(timeout_s):
        camera._go_on_to(clock.now_s() + timeout_s)

    since_s = clock.now_s()
    monkeypatch.setattr(camera, "next_frame", nothing)
    until(vernier, Mode.SAFE, limit_s=1.0)

    limit_s = vernier.rig.interlocks["frame_missing"].stale_s
    assert vernier.mode_changes[-1].time_s - since_s <= limit_s + 2 * vernier.rig.camera.period_s


def test_devices_that_do_not_open_leave_the_instrument_off_and_say_why(simulate_with, monkeypatch):
    simulation = simulate_with()
    error = DeviceTimeout("piezo right", "/dev/ttyUSB0", "an answer in 1 s", "none", "is it on?")
    monkeypatch.setattr(simulation.devices.loops["right"].piezo, "open", failing(error))

    simulation.command(Standby())

    assert mode_of(simulation) is Mode.OFF
    assert any("/dev/ttyUSB0" in event.message for event in events_of(simulation))


def test_what_happens_while_the_instrument_is_closed_is_recorded(vernier, monkeypatch):
    replies = []
    piezo = vernier.devices.loops["right"].piezo
    monkeypatch.setattr(piezo, "close", failing(OSError("stuck")))
    vernier.supervisor.stop("shutting down")
    vernier.supervisor.post(Acquire(), replies.append)
    vernier.supervisor.close()

    assert any("right piezo did not close well" in e.message for e in events_of(vernier))
    assert [(reply.accepted, reply.text) for reply in replies] == [(False, "shutting down")]


def test_what_comes_while_slow_devices_are_closed_is_answered_at_once(vernier, monkeypatch):
    answered, recorded = [], []

    def slow():
        replies = []
        vernier.supervisor.post(Recover(), replies.append, "ada")
        answered.append([(reply.accepted, reply.text) for reply in replies])

    monkeypatch.setattr(vernier.devices.loops["right"].piezo, "close", slow)
    monkeypatch.setattr(vernier.supervisor, "_record", recorded.append)
    vernier.supervisor.close()

    assert answered
    assert all(replies == [(False, "shutting down")] for replies in answered)
    commands = [record for record in recorded if isinstance(record, CommandRecord)]
    assert [record.text for record in commands] == ["shutting down"] * len(answered)


def test_what_comes_after_the_instrument_is_closed_is_answered(vernier):
    replies = []
    vernier.supervisor.close()
    vernier.supervisor.post(Acquire(), replies.append)
    vernier.supervisor.post(Stop(), replies.append)

    assert [(reply.accepted, reply.text) for reply in replies] == [
        (False, "shutting down"),
        (True, "shutting down"),
    ]


def test_a_command_that_waits_for_a_step_longer_than_its_sender_is_refused_and_a_stop_is_not(
    vernier,
):
    replies, sent_s = [], vernier.clock.now_s() - 1.9
    vernier.supervisor.post(Release(sent_s=sent_s), replies.append)
    vernier.supervisor.step()

    assert not replies[0].accepted
    assert "Release was sent 1.9 s ago" in replies[0].text
    assert mode_of(vernier) is Mode.VERNIER
    vernier.supervisor.post(Stop(sent_s=sent_s), replies.append)
    vernier.supervisor.step()
    assert mode_of(vernier) is Mode.SAFE


def test_two_devices_that_fail_at_once_are_each_told_once(vernier, monkeypatch):
    silent = DeviceTimeout("piezo", "/dev/ttyUSB0", "an answer", "none")
    unplugged = DeviceUnreachable("camera", "127.0.0.1:3956", "an answer", "none")
    monkeypatch.setattr(vernier.devices.loops["right"].piezo, "stack_volts", failing(silent))
    monkeypatch.setattr(vernier.devices.camera, "next_frame", failing(unplugged))
    watch = vernier.supervisor._camera
    for _ in range(20):
        watch.ready = True  # a camera that is opened again and again, and fails each time
        vernier.run(1.0)

    errors = [event.message for event in events_of(vernier) if event.severity == "error"]
    assert len(errors) == 2
    assert sum("/dev/ttyUSB0" in message for message in errors) == 1
    assert sum("3956" in message for message in errors) == 1


def test_a_mirror_that_is_turned_off_again_and_again_keeps_its_slew_limit(vernier):
    vernier.command(Release())
    fsm = vernier.rig.loops["right"].fsm
    vernier.run(3.0)
    urad = 0.9e6 * fsm.range_rad
    assert vernier.command(SetBiasOffset(az_urad=urad, el_urad=0.0)).accepted
    vernier.run(1.0)
    before_v = vernier.supervisor.loops["right"].mirror.stack_v.copy()
    for _ in range(5):
        vernier.supervisor.post(Off(), lambda _reply: None)
    vernier.supervisor.step()

    moved_v = np.abs(vernier.supervisor.loops["right"].mirror.stack_v - before_v).max()
    assert 0 < moved_v <= fsm.slew_v_per_s * vernier.rig.camera.period_s * (1 + 1e-9)
    vernier.run(1.0)
    assert vernier.command(Off()).accepted


def test_the_stacks_are_watched_on_after_the_da_has_failed(vernier, monkeypatch):
    error = DeviceTimeout("D/A", "127.0.0.1:502", "an answer", "none")
    monkeypatch.setattr(vernier.devices.loops["right"].dac, "confirm", failing(error))
    until(vernier, Mode.SAFE, limit_s=0.5)
    vernier.records.clear()
    vernier.run(5.0)

    readings = [record for record in vernier.records if isinstance(record, PiezoReading)]
    assert len(readings) >= 4
    health = {r.device: r.state for r in vernier.records if isinstance(r, DeviceHealth)}
    assert health["right piezo"] == "ok"
    assert health["right D/A"] == "closed"

    silent = DeviceTimeout("piezo", "/dev/ttyUSB0", "an answer", "none")
    monkeypatch.setattr(vernier.devices.loops["right"].piezo, "stack_volts", failing(silent))
    vernier.run(3.0)
    assert any("/dev/ttyUSB0" in event.message for event in events_of(vernier))


def test_devices_that_were_closed_are_reported_so_at_once(vernier):
    """Not up to a second later, in which consoles would show them open in OFF."""
    vernier.command(Release())
    vernier.run(3.0)
    vernier.records.clear()
    assert vernier.command(Off()).accepted
    until(vernier, Mode.OFF, limit_s=5.0)
    vernier.run(2 * vernier.rig.camera.period_s)

    health = {r.device: r.state for r in vernier.records if isinstance(r, DeviceHealth)}
    assert set(health.values()) == {"closed"}


def test_a_piezo_amplifier_that_is_closed_is_not_asked(vernier, monkeypatch):
    vernier.command(Release())
    vernier.run(3.0)
    assert vernier.command(Off()).accepted
    piezo = vernier.devices.loops["right"].piezo
    monkeypatch.setattr(piezo, "stack_volts", failing(AssertionError("asked")))
    vernier.records.clear()
    vernier.run(5.0)

    assert not any("asked" in event.message for event in events_of(vernier))


def test_after_a_stall_the_newest_frame_is_acted_on_and_older_ones_are_logged(vernier):
    last = vernier.ticks[-1]
    vernier.records.clear()
    vernier.clock.sleep_until(vernier.clock.now_s() + 7 * vernier.rig.camera.period_s)
    vernier.supervisor.step()
    (tick,) = (record for record in vernier.records if isinstance(record, Tick))
    frames = [record.number for record in vernier.records if isinstance(record, FrameRecord)]

    assert tick.number == last.number + 7
    assert frames == list(range(last.number + 1, last.number + 8))
    assert tick.frames_skipped == last.frames_skipped + 6
    assert tick.frames_lost == last.frames_lost
    vernier.run(3.0)
    assert mode_of(vernier) is Mode.VERNIER
    assert vernier.ticks[-1].frames_skipped == tick.frames_skipped
    assert not vernier.supervisor.loops["right"].interlocks.tripped


def test_a_star_is_released_while_another_loops_devices_are_opened():
    pair = Simulation(load_rig(default_rig_path().with_name("two-stars.toml")), 0)
    for command in (Standby(loop="right"), Acquire(loop="right")):
        assert pair.command(command).accepted
        pair.run(0.5)
    pair.supervisor._device_jobs._executor = SlowExecutor()
    assert pair.command(Standby(loop="left")).accepted
    pair.run(0.1)
    assert pair.supervisor._device_jobs.busy

    assert pair.command(Release(loop="right")).accepted
    assert pair.supervisor.loops["right"].mode is Mode.STANDBY


def test_a_place_to_search_at_is_of_one_loop():
    pair = Simulation(load_rig(default_rig_path().with_name("two-stars.toml")), 0)
    assert pair.command(Standby()).accepted
    pair.run(0.5)
    place = {"expected_az_sky_arcsec": 200.0, "expected_el_sky_arcsec": 0.0}

    reply = pair.command(Acquire(**place))

    assert reply.text == "acquire: a place is of one loop; name the loop: right, left"
    assert pair.command(Acquire(loop="left", **place)).accepted


def test_what_the_service_leaves_after_the_end_is_recorded_once_it_has_ended(vernier):
    vernier.supervisor.stop("shutting down")
    vernier.supervisor.close()
    vernier.supervisor.post(Stop(), lambda _reply: None, "anna")
    vernier.supervisor.report_event("warning", "service", "anna: 100 messages")

    vernier.supervisor.record_left()

    stops = [record for record in vernier.records if isinstance(record, CommandRecord)]
    assert stops[-1].sender == "anna"
    assert events_of(vernier)[-1].message == "anna: 100 messages"


def test_two_stars_are_not_sent_to_one_place():
    pair = Simulation(load_rig(default_rig_path().with_name("two-stars.toml")), 0)
    right, left = (pair.supervisor.loops[name].target_px.tolist() for name in ("right", "left"))

    refused = pair.command(SetTarget(loop="right", az_px=left[0] + 5.0, el_px=left[1] - 5.0))
    accepted = pair.command(SetTarget(loop="right", az_px=left[0] + 5.0, el_px=left[1] - 7.0))

    assert refused.text == (
        "target 17 15: there or on the straight way there the star comes too near that of loop left, at 12 20; "
        "expected more than 6 px between them along one axis; go round it by several targets"
    )
    assert accepted.accepted
    assert pair.command(SetTarget(loop="right", az_px=right[0], el_px=right[1])).accepted


@pytest.mark.long
def test_a_star_that_is_held_is_not_sent_past_another_ones_place():
    records = []
    rig = load_rig(default_rig_path().with_name("two-stars.toml"))
    pair = Simulation(rig, 0, record=records.append)
    right, left = (pair.supervisor.loops[name].target_px.tolist() for name in ("right", "left"))
    beyond = SetTarget(loop="left", az_px=34.5, el_px=left[1])
    back = SetTarget(loop="left", az_px=left[0], el_px=left[1])
    assert pair.command(beyond).accepted  # nothing is held, and nothing goes there
    assert pair.command(back).accepted
    pair.acquire()
    while any(loop.mode is not Mode.VERNIER for loop in pair.supervisor.loops.values()):
        assert pair.clock.now_s() < 60
        pair.run(0.5)
    records.clear()

    refused = pair.command(beyond)
    assert f"too near that of loop right, at {right[0]:g} {right[1]:g};" in refused.text

    for az_px, el_px in ((left[0], 32.0), (34.5, 32.0), (34.5, left[1])):  # round it
        assert pair.command(SetTarget(loop="left", az_px=az_px, el_px=el_px)).accepted
        pair.run(12.0)
    changes = [record for record in records if isinstance(record, ModeChange)]
    assert not [change for change in changes if change.target == "ACQUISITION"]
    held_px = pair.supervisor.loops["left"].pointing.command_px
    assert held_px == pytest.approx((34.5, left[1]), abs=0.1)
