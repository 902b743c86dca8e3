"""Positions from the drive: where the motors are, and when they were there, however late the link has them."""

import math
import time

import can
import numpy as np
import pytest
from cia402_bench import STILL, bridged, reading_of, wait_until

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers


def test_positions_are_the_motor_angles_in_whole_counts(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    first = reading_of(amplifiers, [20.0, -10.0])
    time.sleep(0.05)
    second = reading_of(amplifiers, [0.0, 0.0])
    count_rad = 2 * math.pi / bench.siderostat.encoder_counts_per_rev
    settled = reading_of(amplifiers)
    assert settled.position_rad == pytest.approx(bench.motors.position_rad(), abs=0.51 * count_rad)
    counts = np.array(settled.position_rad) / count_rad
    assert counts == pytest.approx(np.round(counts), abs=1e-6)
    assert second.position_rad[0] > first.position_rad[0]
    assert second.position_rad[1] < first.position_rad[1]
    assert first.time_s < second.time_s < time.monotonic()


class LaggingPositions:
    """Positions as the link delivers them: late by one of our frames, or one of them never."""

    def __init__(self) -> None:
        self.late = False
        self.lose = 0
        self.held: list[can.Message] = []

    def __call__(self, message):
        if message.arbitration_id in {protocol.SYNC_ID, 0x601}:
            released, self.held = self.held, []
            return [message, *released]
        if message.arbitration_id != 0x181:
            return [message]
        if self.lose:
            self.lose -= 1
            return []
        if self.late:
            self.held.append(message)
            return []
        return [message]


@pytest.fixture
def lagging(bench):
    """Positions' lag, and opened amplifiers with a period that no stall of the machine fills."""
    positions = LaggingPositions()
    with bridged(bench, positions) as siderostat:
        servo = siderostat.servo.model_copy(update={"rate_hz": 5.0})
        amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"servo": servo}))
        amplifiers.open()
        try:
            yield positions, amplifiers
        finally:
            positions.late = False
            amplifiers.close()


def test_positions_that_come_late_are_dated_with_the_sync_that_they_answer(bench, lagging):
    positions, amplifiers = lagging
    positions.late = True
    starts_s = []
    for turn in range(4):
        bench.motors.turn_to(0.05 * turn)
        starts_s.append(time.monotonic())
        reading = amplifiers.exchange(STILL)
        wait_until(lambda: len(positions.held) == 1)
        if turn == 0:
            assert reading is None
            continue
        assert reading.position_rad[0] == pytest.approx(0.05 * (turn - 1), abs=1e-3)
        assert starts_s[turn - 1] < reading.time_s < starts_s[turn]


def test_after_lost_positions_readings_are_dated_right_again(lagging):
    positions, amplifiers = lagging
    reading_of(amplifiers)
    positions.lose = 1
    assert amplifiers.exchange(STILL) is None
    for _ in range(15):
        start_s = time.monotonic()
        reading = amplifiers.exchange(STILL)
        assert reading is not None
    assert reading.time_s > start_s


def test_a_slow_link_is_not_taken_for_lost_positions(lagging):
    positions, amplifiers = lagging
    positions.late = True
    amplifiers.exchange(STILL)
    for _ in range(25):
        wait_until(lambda: len(positions.held) == 1)
        start_s = time.monotonic()
        reading = amplifiers.exchange(STILL)
        assert reading is not None
        assert reading.time_s < start_s


def test_positions_go_on_where_the_encoder_counter_wraps(bench, amplifiers):
    count_rad = 2 * math.pi / bench.siderostat.encoder_counts_per_rev
    bench.motors.turn_to((2**31 - 10) * count_rad)
    amplifiers.open()
    before = reading_of(amplifiers)
    bench.motors.turn_to((2**31 + 10) * count_rad)
    after = reading_of(amplifiers)
    steps = np.subtract(after.position_rad, before.position_rad) / count_rad
    assert steps == pytest.approx([20.0, 20.0], abs=0.1)
