"""A log through today's code: what is told where it is not the same."""

import math

import msgspec
import pytest
from samples.replay_courses import hold_a_star, replayed

from fitctl.logging.records import CommandRecord, FrameRecord, Tick
from fitctl.messages.commands import Recover


def test_another_controller_commands_otherwise_from_its_first_tick_on(held_log):
    path, since_s = held_log()
    result = replayed(path, change=["loops.right.vernier.controller=minimum-variance"])

    loop = result.loops["right"]
    assert not result.same
    assert loop.mode.ticks == loop.differences["star_px"].ticks == 0
    stacks = loop.differences["stacks_v"]
    assert stacks.first_s == pytest.approx(since_s, abs=0.021)
    assert stacks.worst > stacks.rms > 1e-3


def test_a_mode_that_is_left_by_todays_rig_is_told_with_its_time(held_log):
    path, since_s = held_log()
    tight = (
        "interlocks.fsm_edge={ quantity = 'fsm_range_fraction', high = 1e-6, for_s = 0.5, "
        "modes = ['VERNIER'], action = 'safe', reset = 'hand' }"
    )
    mode = replayed(path, change=[tight]).loops["right"].mode

    assert (mode.then, mode.now) == ("VERNIER", "SAFE")
    assert mode.first_s == pytest.approx(since_s + 0.5, abs=0.05)
    assert mode.ticks == pytest.approx((2.0 - 0.5) * 50, abs=8)


def test_one_bit_of_one_voltage_is_told(held_log):
    changed = []

    def one_bit(record):
        if isinstance(record, Tick) and record.mode == "VERNIER" and not changed:
            volts = math.nextafter(record.stack2_v, 10.0)
            changed.append((record.time_s, volts - record.stack2_v))
            return msgspec.structs.replace(record, stack2_v=volts)
        return record

    path, _ = held_log(change=one_bit)
    found = replayed(path).loops["right"].differences["stacks_v"]

    ((time_s, bit_v),) = changed
    assert found.ticks >= 1
    assert (found.first_s, found.worst >= bit_v) == (time_s, True)
    assert found.worst < 1e-12  # whatever follows from it


def test_one_dark_frame_in_the_log_is_seen_once_and_acted_upon(held_log):
    def darkened(record):
        if isinstance(record, FrameRecord) and record.number == 80:
            return msgspec.structs.replace(record, data=bytes(len(record.data)))
        return record

    path, _ = held_log(change=darkened)
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
    assert result.refused == [
        "Recover: recover is not available in VERNIER. Available: release, stop"
    ]


def test_a_frame_that_is_not_in_the_log_is_counted(held_log):
    def without(record):
        return None if isinstance(record, FrameRecord) and record.number == 20 else record

    path, _ = held_log(change=without)

    assert replayed(path).loops["right"].frames_missing == 1
