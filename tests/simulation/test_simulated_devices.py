"""Simulated devices on the plant, on the virtual clock."""

import numpy as np

from fitctl.clock import VirtualClock
from fitctl.model.plant import Plant
from fitctl.simulation.devices import SimulatedAmplifiers

PERIOD_S = 0.002
STILL = (0.0, 0.0)
# Motions as a servo commands them, with rests between them in which the motors come to rest to the last bit.
COMMANDS = [
    *50 * [STILL],
    *20 * [(0.5, -0.2)],
    *400 * [STILL],
    *[(0.01, 0.0), STILL] * 5,
    *400 * [STILL],
    *3 * [(-2.0, 1.0)],
    *400 * [STILL],
]


def run(rig, *, plant_goes_on):
    """Readings, true motor angles at each, and how often the plant was advanced."""
    clock, plant = VirtualClock(), Plant(rig, [3])
    part = plant.stellar_loops["right"]
    advance, calls = part.advance, []
    part.advance = lambda time_s: (calls.append(time_s), advance(time_s))
    amplifiers = SimulatedAmplifiers(part, clock, counts_per_rev=10_000_000)
    amplifiers.enable()
    readings, angles_rad = [], []
    for period, velocity_rad_s in enumerate(COMMANDS):
        clock.sleep_until(period * PERIOD_S)
        if plant_goes_on:
            plant.advance(clock.now_s())
        readings.append(amplifiers.exchange(velocity_rad_s))
        angles_rad.append(part.state.motor_rad[0].copy())
    plant.advance(clock.now_s())
    return readings, np.array(angles_rad), part.history_px(0.0, clock.now_s()), calls


def test_motors_at_rest_are_read_as_if_the_plant_had_gone_on(rig):
    readings, angles_rad, star_px, calls = run(rig, plant_goes_on=False)
    expected, expected_rad, expected_px, _ = run(rig, plant_goes_on=True)
    assert readings == expected
    assert np.array_equal(angles_rad, expected_rad)
    assert np.array_equal(star_px, expected_px)
    assert len(calls) < len(COMMANDS) / 2
