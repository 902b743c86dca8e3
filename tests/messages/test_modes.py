"""The table of modes, row by row and all of it."""

import pytest

from fitctl.messages.modes import (
    COMMANDS,
    MEANING,
    TRACKING,
    TRANSITIONS,
    Mode,
    Trigger,
    mermaid,
    transition,
    usable_commands,
)


def test_no_mode_has_two_answers_to_one_trigger():
    pairs = [(row.source, row.trigger) for row in TRANSITIONS]

    assert len(pairs) == len(set(pairs))


@pytest.mark.parametrize("mode", Mode)
def test_stop_leads_to_safe_from_every_mode(mode):
    assert transition(mode, Trigger.STOP).target is Mode.SAFE


@pytest.mark.parametrize("mode", [Mode.STANDBY, *TRACKING])
def test_a_fault_leads_to_safe_from_every_powered_mode(mode):
    assert transition(mode, Trigger.FAULT).target is Mode.SAFE


@pytest.mark.parametrize("mode", Mode)
def test_every_mode_can_be_left_and_reached_from_off(mode):
    reached, frontier = {Mode.OFF}, [Mode.OFF]
    while frontier:
        source = frontier.pop()
        for row in TRANSITIONS:
            if row.source is source and row.target not in reached:
                reached.add(row.target)
                frontier.append(row.target)

    assert mode in reached
    assert any(row.source is mode and row.target is not mode for row in TRANSITIONS)


def test_nothing_but_a_command_leaves_off_standby_or_safe_for_a_mode_that_moves():
    for row in TRANSITIONS:
        if row.target in TRACKING and row.source not in TRACKING:
            assert row.trigger in COMMANDS


def test_usable_commands_are_those_that_have_a_row():
    assert usable_commands(Mode.STANDBY) == [Trigger.ACQUIRE, Trigger.STOP, Trigger.OFF]
    assert usable_commands(Mode.ACQUISITION) == [Trigger.ACQUIRE, Trigger.HOLD, Trigger.STOP]
    assert usable_commands(Mode.SAFE) == [Trigger.STOP, Trigger.RECOVER, Trigger.OFF]


def test_what_has_no_row_means_nothing():
    assert transition(Mode.OFF, Trigger.ACQUIRE) is None
    assert transition(Mode.SAFE, Trigger.ACQUIRE) is None


def test_every_mode_has_a_meaning_for_people_and_a_place_in_the_diagram():
    diagram = mermaid()

    for mode in Mode:
        assert MEANING[mode]
        assert mode.name in diagram
