"""A loop that writes its mirror several times a frame."""

import itertools

import pytest
from instruments.simulated import NEAR, events_of, failing, mode_of, until

from fitctl.drivers.interface import DeviceTimeout
from fitctl.logging.records import InjectionRecord
from fitctl.messages.modes import Mode
from fitctl.simulation.statistics import true_residual_rms

WRITES = "loops.right.fsm.dac.writes_per_frame=5"
BEST = "loops.right.vernier.controller=minimum-variance"
SHAKEN = (
    "plant.loops.right.lines=[{frequency_hz=20.0, rms_px=0.07, direction_deg=45.0, damping=0.002, "
    "drift_hz_per_min=0.0}]"
)


def held(simulate_with, *overrides):
    simulation = simulate_with(*overrides, **NEAR)
    simulation.acquire()
    return until(simulation, Mode.VERNIER)


def writes_of(simulation):
    """How often the D/A is sent something, from now on."""
    dac, sent = simulation.devices.loops["right"].dac, []
    send_v = dac.send_v
    dac.send_v = lambda volts: (sent.append(simulation.clock.now_s()), send_v(volts))
    return sent


def test_in_vernier_it_is_written_five_times_a_frame_at_equal_intervals(simulate_with):
    simulation = held(simulate_with, WRITES, BEST)
    sent_s = writes_of(simulation)
    simulation.run(1.0)

    assert len(sent_s) == pytest.approx(250, abs=5)
    gaps_s = [late - early for early, late in itertools.pairwise(sent_s)]
    assert gaps_s == pytest.approx([0.004] * len(gaps_s), abs=1e-6)


@pytest.mark.parametrize(
    "given", [[WRITES], [BEST]], ids=["a design that does not predict", "one write"]
)
def test_otherwise_once(simulate_with, given):
    simulation = held(simulate_with, *given)
    sent_s = writes_of(simulation)
    simulation.run(1.0)

    assert len(sent_s) == pytest.approx(50, abs=1)


def test_what_is_written_between_frames_is_logged(simulate_with):
    simulation = held(simulate_with, WRITES, BEST)
    simulation.records.clear()
    simulation.run(1.0)

    logged = [record for record in simulation.records if isinstance(record, InjectionRecord)]
    assert len(logged) == pytest.approx(200, abs=5)


def test_a_da_that_fails_between_frames_makes_safe_and_is_named(simulate_with):
    simulation = held(simulate_with, WRITES, BEST)
    dac = simulation.devices.loops["right"].dac
    dac.confirm = failing(DeviceTimeout("D/A", "here", "an answer", "none", "look"))
    simulation.run(0.04)

    assert mode_of(simulation) is Mode.SAFE
    assert any("here" in event.message for event in events_of(simulation))


def test_no_write_follows_a_frozen_star(simulate_with):
    simulation = held(simulate_with, WRITES, BEST)
    simulation.camera.next_frame = lambda timeout_s: simulation.camera._go_on_to(
        simulation.clock.now_s() + timeout_s
    )
    simulation.run(0.1)
    sent_s = writes_of(simulation)
    simulation.run(0.4)

    assert len(sent_s) == pytest.approx(10, abs=1)  # those of the ticks, for the D/A's watchdog


@pytest.mark.long
def test_a_fast_line_is_followed_between_frames(simulate_with):
    def left_px(*overrides):
        simulation = held(
            simulate_with,
            *overrides,
            SHAKEN,
            "loops.right.learn=on",
            "loops.right.fastest_line_hz=25.0",
            BEST,
        )
        simulation.run(110.0)
        loop = simulation.supervisor.loops["right"]
        now_s = simulation.clock.now_s()
        assert loop.controller == "learnt"
        return max(
            true_residual_rms(simulation.plants["right"], loop.target_px, now_s - 30.0, now_s)
        )

    assert left_px(WRITES) < 0.8 * left_px()
