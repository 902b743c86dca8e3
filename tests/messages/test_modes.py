"""The table of modes, row by row and all of it."""

import pytest

from fitctl.messages.modes import (
    COMMANDS,
    MEANING,
    METROLOGY_MODES,
    METROLOGY_TRANSITIONS,
    POINTING,
    STELLAR_MODES,
    TRANSITIONS,
    Mode,
    Trigger,
    mermaid,
    transition,
    usable_commands,
)

KINDS = {TRANSITIONS: STELLAR_MODES, METROLOGY_TRANSITIONS: METROLOGY_MODES}
MODES_OF_KINDS = [(table, mode) for table, modes in KINDS.items() for mode in modes]


@pytest.mark.parametrize("table", KINDS)
def test_no_mode_has_two_answers_to_one_trigger(table):
    pairs = [(row.source, row.trigger) for row in table]

    assert len(pairs) == len(set(pairs))


@pytest.mark.parametrize(("table", "mode"), MODES_OF_KINDS)
def test_stop_leads_to_safe_from_every_mode(table, mode):
    assert transition(mode, Trigger.STOP, table).target is Mode.SAFE


@pytest.mark.parametrize(("table", "mode"), MODES_OF_KINDS)
def test_a_fault_leads_to_safe_from_every_powered_mode(table, mode):
    row = transition(mode, Trigger.FAULT, table)
    if mode in {Mode.OFF, Mode.SAFE}:
        assert row is None
    else:
        assert row.target is Mode.SAFE


@pytest.mark.parametrize(("table", "mode"), MODES_OF_KINDS)
def test_every_mode_can_be_left_and_reached_from_off(table, mode):
    reached, frontier = {Mode.OFF}, [Mode.OFF]
    while frontier:
        source = frontier.pop()
        for row in table:
            if row.source is source and row.target not in reached:
                reached.add(row.target)
                frontier.append(row.target)

    assert mode in reached
    assert any(row.source is mode and row.target is not mode for row in table)


@pytest.mark.parametrize(("table", "modes"), KINDS.items())
def test_a_table_has_the_modes_of_its_kind_and_no_other(table, modes):
    assert {row.source for row in table} | {row.target for row in table} == set(modes)


@pytest.mark.parametrize("table", KINDS)
def test_nothing_but_a_command_leaves_off_standby_or_safe_for_a_mode_that_moves(table):
    for row in table:
        if row.target in POINTING and row.source not in POINTING:
            assert row.trigger in COMMANDS


def test_the_numbers_that_logs_carry_never_change():
    assert [(mode.name, int(mode)) for mode in Mode] == [
        ("OFF", 0),
        ("STANDBY", 1),
        ("ACQUISITION", 2),
        ("COARSE", 3),
        ("VERNIER", 4),
        ("SAFE", 5),
        ("EXPERIMENT", 6),
        ("LOCKED", 7),
    ]


def test_usable_commands_are_those_that_have_a_row():
    assert usable_commands(Mode.STANDBY) == [Trigger.ACQUIRE, Trigger.STOP, Trigger.OFF]
    assert usable_commands(Mode.ACQUISITION) == [Trigger.ACQUIRE, Trigger.RELEASE, Trigger.STOP]
    assert usable_commands(Mode.SAFE) == [Trigger.STOP, Trigger.RECOVER, Trigger.OFF]


def test_what_has_no_row_means_nothing():
    assert transition(Mode.OFF, Trigger.ACQUIRE) is None
    assert transition(Mode.SAFE, Trigger.ACQUIRE) is None


def test_every_mode_has_a_meaning_for_people_and_a_place_in_the_diagram():
    for table, modes in KINDS.items():
        diagram = mermaid(table)
        for mode in modes:
            assert MEANING[mode]
            assert mode.name in diagram
