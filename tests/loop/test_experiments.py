"""Experiments: open loop, as told, no farther than the stages reach; and another controller in mid flight."""

import math

import msgspec
import numpy as np
import pytest

from fitctl.drivers.interface import DeviceTimeout
from fitctl.identify.record import gather
from fitctl.logging.records import Event, ExperimentStart, InjectionRecord
from fitctl.messages.commands import Acquire, Experiment, Release, SetController, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive, drive_value, experiment_s
from fitctl.model.optics import scales
from fitctl.stages.drives import refused_drives

SWEEP = Drive(
    channel="fsm_az", shape="triangle", amplitude=3.0, frequency_hz=1.0, duration_s=4.0, start_s=0.5
)
SCAN = Drive(channel="siderostat_el", shape="sine", amplitude=2.0, frequency_hz=0.5, duration_s=4.0)


@pytest.fixture
def held(simulate_with):
    """A star held in VERNIER, and every record from then on."""

    def make(*overrides):
        simulation = simulate_with(*overrides, star_offset_px=(2.0, -1.0))
        simulation.acquire()
        loop = simulation.supervisor.loops["right"]
        while loop.mode is not Mode.VERNIER:
            assert simulation.clock.now_s() < 60
            simulation.run(0.5)
        simulation.run(5.0)
        simulation.records.clear()
        return simulation, loop, simulation.records

    return make


def begin(simulation, *drives, name="try"):
    reply = simulation.command(Experiment(loop="right", name=name, drives=list(drives)))
    assert reply.accepted, reply.text


# ---------------------------------------------------------------- the course of an experiment


def test_the_mirror_moves_as_told_and_the_camera_sees_it(held):
    simulation, loop, records = held()
    begin(simulation, SWEEP)
    simulation.run(6.0)

    seen = gather(records, "right", "try")
    told_px = [drive_value(SWEEP, t - seen.injected_s[0]) for t in seen.tick["mid_exposure_s"]]
    moved_px = seen.star_px[:, 0] - np.mean(seen.star_px[:, 0])
    # Hysteresis, the air path and up to 7 ms of staircase are what is left.
    assert np.std(moved_px - told_px) < 0.2 * np.std(moved_px)
    assert np.ptp(seen.star_px[:, 1]) < 2.0
    assert loop.mode in {Mode.COARSE, Mode.VERNIER}


def test_the_siderostat_moves_as_told_and_returns(held):
    simulation, loop, records = held()
    before_rad = simulation.supervisor.servos["right"].position_rad.copy()
    begin(simulation, SCAN)
    simulation.run(1.0)
    away_rad = simulation.supervisor.servos["right"].position_rad - before_rad
    while loop.mode is Mode.EXPERIMENT:
        simulation.run(0.02)

    motor_px_per_rad = scales(simulation.rig, loop.settings).motor_px_per_rad
    assert away_rad[1] * motor_px_per_rad == pytest.approx(0.0, abs=0.3)
    seen = gather(records, "right", "try")
    swing_px = np.ptp(seen.motor_rad, axis=0) * motor_px_per_rad
    assert swing_px == pytest.approx([0.0, 4.0], abs=0.1)
    after_rad = simulation.supervisor.servos["right"].position_rad
    assert after_rad == pytest.approx(before_rad, abs=0.1)


@pytest.mark.long
def test_after_an_experiment_the_star_is_held_again(held):
    simulation, loop, _ = held()
    begin(simulation, SWEEP)
    simulation.run(SWEEP.start_s + SWEEP.duration_s + 10.0)
    assert loop.mode is Mode.VERNIER
    error_px = [math.hypot(t.error_az_px, t.error_el_px) for t in simulation.ticks[-50:]]
    assert np.sqrt(np.mean(np.square(error_px))) < 0.1


def test_the_log_tells_what_was_asked_and_every_voltage(held):
    simulation, _, records = held()
    begin(simulation, SWEEP)
    simulation.run(6.0)
    (start,) = [r for r in records if isinstance(r, ExperimentStart)]
    assert msgspec.json.decode(start.drives_json, type=list[Drive]) == [SWEEP]
    injected = [r for r in records if isinstance(r, InjectionRecord)]
    apart_s = np.diff([r.time_s for r in injected])
    assert len(injected) > 500
    assert apart_s.max() < 0.01  # no voltage is missing


# ---------------------------------------------------------------- its ends


def test_stop_ends_an_experiment_at_once_and_the_mirror_goes_home(held):
    simulation, loop, _ = held()
    begin(simulation, SWEEP, SCAN)
    simulation.run(0.8)
    simulation.command(Stop())
    assert loop.mode is Mode.SAFE
    simulation.run(1.0)
    assert loop.mirror.at_bias()
    assert np.allclose(simulation.plants["right"].inputs.stack_v[0], 5.0, atol=1e-3)


def test_hold_ends_an_experiment_in_standby(held):
    simulation, loop, _ = held()
    begin(simulation, SCAN)
    simulation.run(1.0)
    assert simulation.command(Release()).accepted
    assert loop.mode is Mode.STANDBY


def test_a_star_lost_in_an_experiment_is_searched_for(held):
    simulation, loop, _ = held()
    begin(simulation, SCAN)
    simulation.camera._scene._flux_dn = simulation.camera._scene._flux_dn * 0.0
    simulation.run(0.5)
    assert loop.mode is Mode.ACQUISITION


def test_a_d_a_that_fails_in_an_experiment_leads_to_safe(held):
    simulation, loop, records = held()
    begin(simulation, SWEEP)
    simulation.run(0.2)

    def fails(_volts):
        raise DeviceTimeout("D/A", "here", "an answer", "none", "look at it")

    loop.mirror.injector._dac.send_v = fails
    simulation.run(0.1)
    assert loop.mode is Mode.SAFE
    assert any(isinstance(r, Event) and "D/A" in r.message for r in records)


def test_an_error_of_our_own_in_an_experiment_leads_to_safe_too(held, monkeypatch):
    simulation, loop, _ = held()
    begin(simulation, SWEEP)
    monkeypatch.setattr(loop.mirror.injector, "volts", lambda *_: 1 / 0)
    simulation.run(0.1)
    assert loop.mode is Mode.SAFE


# ---------------------------------------------------------------- what is refused


def test_an_experiment_needs_a_star_in_hand(simulate_with):
    simulation = simulate_with()
    simulation.command(Standby())
    reply = simulation.command(Experiment(loop="right", name="try", drives=[SWEEP]))
    assert not reply.accepted
    assert "VERNIER" in reply.text
    simulation.command(Acquire())
    assert not simulation.command(Experiment(loop="right", name="try", drives=[SWEEP])).accepted


def test_no_experiment_is_made_while_the_loop_waits(held, monkeypatch):
    simulation, loop, _ = held()
    loop.waits_for = "the link of metrology"
    monkeypatch.setattr(loop, "_why_wait", lambda *_: "the link of metrology")

    reply = simulation.command(Experiment(loop="right", name="try", drives=[SWEEP]))
    assert not reply.accepted
    assert "waits for the link of metrology" in reply.text

    loop.start_experiment("try", [SWEEP])  # at the same moment as the wait
    simulation.run(0.1)
    assert loop.mode is not Mode.EXPERIMENT


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"amplitude": math.nan}, "finite"),
        ({"amplitude": 8.0}, "V about its bias"),
        ({"channel": "stack1", "amplitude": 5.1}, "V about its bias"),
        ({"channel": "siderostat_az", "amplitude": 1e4}, "travel"),
        ({"duration_s": 1e4}, "up to 600 s"),
        ({"frequency_hz": 1e308}, "Hz"),
        ({"frequency_hz": -1.0}, "Hz"),
        ({"end_frequency_hz": 100.0}, "Hz"),
        ({"duration_s": -1.0}, "and last"),
        ({"start_s": -1.0}, "begin with the experiment"),
    ],
)
def test_what_the_stages_cannot_do_is_refused(rig, change, why):
    assert why in refused_drives(rig, "right", [msgspec.structs.replace(SWEEP, **change)])


def test_motions_at_one_time_are_taken_together(rig):
    other = msgspec.structs.replace(SWEEP, channel="fsm_el", amplitude=5.0)
    later = msgspec.structs.replace(other, start_s=10.0)
    assert "V about its bias" in refused_drives(rig, "right", [SWEEP, other])
    assert refused_drives(rig, "right", [SWEEP, later]) == ""
    assert experiment_s([SWEEP, later]) == 14.0


# ---------------------------------------------------------------- another controller


@pytest.mark.long
@pytest.mark.parametrize("after", ["lqg-ltr", "minimum-variance", "fslq", "eq20"])
def test_controllers_are_exchanged_on_a_running_loop_without_a_bump(held, after):
    before = "eq20" if after != "eq20" else "minimum-variance"
    simulation, loop, _ = held(f"loops.right.vernier.controller={before}")
    simulation.run(10.0)
    quiet_px = error_px(simulation, 5.0).max()
    assert simulation.command(SetController(name=after)).accepted
    simulation.run(5.0)

    assert loop.controller == after
    assert loop.mode is Mode.VERNIER
    assert error_px(simulation, 5.0).max() < 1.6 * quiet_px


def error_px(simulation, last_s):
    """True distance from the target over the last seconds, each axis."""
    plant = simulation.plants["right"]
    now_s = simulation.clock.now_s()
    target_px = simulation.supervisor.loops["right"].target_px
    return np.abs(plant.history_px(now_s - last_s, now_s)[:, 0, 0] - target_px)
