import math

import msgspec
import numpy as np
import pytest

from fitctl.logging.records import Event
from fitctl.supervisor.messages import TrippedInterlock
from fitctl.tui.draw.frame import place
from fitctl.tui.palette import parse_target
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import Events, event_lines
from fitctl.tui.widgets.focalplane import FocalPlane, tick_marks
from fitctl.tui.widgets.header import Header
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.stages import Stages, working_point
from fitctl.tui.widgets.traces import Traces, axis_limit_px, trace_lines
from tests.tui.fake import START_S, FakeSupervisor


def shown(supervisor, count=50):
    state = ConsoleState(START_S)
    for message in supervisor.messages(count):
        state.accept(message, message.time_s)
    state.now_s = state.received_s
    return state


def plain(lines):
    return ["".join(segment.text for segment in line) for line in lines]


def changed_tick(state, **fields):
    state.loop.ticks[-1] = msgspec.structs.replace(state.loop.tick, **fields)
    return state.loop.tick


PANELS = (Header, FocalPlane, Traces, Stages, Devices, Timing, Events, Keys)


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("mode", ["OFF", "ACQUISITION", "VERNIER", "SAFE"])
@pytest.mark.parametrize("size", [(39, 3), (80, 20), (3, 1), (200, 60)])
def test_every_panel_draws_in_every_mode_and_size(panel, mode, size):
    panel(shown(FakeSupervisor(mode))).draw(*size)


@pytest.mark.parametrize("panel", PANELS)
def test_every_panel_draws_before_anything_came(panel):
    panel(ConsoleState(START_S)).draw(80, 20)


@pytest.mark.parametrize("panel", [Header, FocalPlane, Traces, Stages, Devices, Timing, Keys])
@pytest.mark.parametrize("mode", ["ACQUISITION", "VERNIER"])
def test_nothing_is_wider_than_its_panel_at_80_columns(panel, mode):
    columns, rows = {
        Header: (80, 3),
        FocalPlane: (40, 20),
        Traces: (39, 8),
        Stages: (39, 4),
        Devices: (39, 2),
        Timing: (39, 3),
        Keys: (80, 1),
    }[panel]
    lines = plain(panel(shown(FakeSupervisor(mode), 450)).draw(columns, rows))
    assert len(lines) <= rows
    assert max(len(line.rstrip()) for line in lines) <= columns


@pytest.mark.parametrize(
    ("worst_px", "limit_px"),
    [(0.0, 0.2), (0.15, 0.2), (0.3, 0.5), (0.99, 2.0), (7.0, 10.0), (19, 20)],
)
def test_the_scale_is_a_sensible_step_that_holds_all_and_shows_the_band(worst_px, limit_px):
    assert axis_limit_px(np.array([worst_px, math.nan]), 0.1) == pytest.approx(limit_px)


def test_the_scale_without_a_star_is_twice_the_requirement():
    assert axis_limit_px(np.full(4, math.nan), 0.25) == pytest.approx(0.5)


def test_the_trace_has_its_scale_beside_it():
    lines = trace_lines(
        np.array([1.0]),
        np.array([0.0]),
        now_s=1.0,
        limit_px=0.2,
        requirement_px=0.1,
        colour="#ffffff",
        columns=40,
        rows=9,
    )
    labels = [line[:5].strip() for line in plain(lines)]
    assert labels == ["+0.2", "", "+0.1", "", "0", "", "−0.1", "", "−0.2"]


def test_the_rms_is_compared_with_the_requirement():
    good = "".join(plain(Traces(shown(FakeSupervisor(error_px=0.03), 400)).draw(80, 20)))
    bad = "".join(plain(Traces(shown(FakeSupervisor(error_px=0.3), 400)).draw(80, 20)))
    assert "✓" in good
    assert "✗" not in good
    assert "✗" in bad
    assert "% of 0.1 px" in good
    assert "mas on the sky" in good


def test_the_working_point_is_at_a_corner_when_one_axis_uses_all():
    state = shown(FakeSupervisor())
    tick = changed_tick(state, fsm_az_rad=1.772e-4, fsm_el_rad=0.0, fsm_range_fraction=1.0)
    assert working_point(tick) == (pytest.approx(1.0), 0.0)
    tick = changed_tick(state, fsm_az_rad=0.0, fsm_el_rad=0.0, fsm_range_fraction=0.0)
    assert working_point(tick) == (0.0, 0.0)


def test_saturation_is_said_in_words():
    state = shown(FakeSupervisor())
    assert "SATURATED" not in "".join(plain(Stages(state).draw(39, 4)))
    changed_tick(state, fsm_saturated=True, fsm_range_fraction=1.0)
    drawn = "".join(plain(Stages(state).draw(39, 4)))
    assert "SATURATED" in drawn
    assert "✗" in drawn


def test_the_search_is_shown_while_searching():
    assert "search" in "".join(plain(Stages(shown(FakeSupervisor("ACQUISITION"))).draw(39, 4)))
    assert "search" not in "".join(plain(Stages(shown(FakeSupervisor("VERNIER"))).draw(39, 4)))


def test_the_window_and_the_centroid_are_where_the_tick_says():
    state = shown(FakeSupervisor())
    tick = changed_tick(state, star_az_px=10.2, star_el_px=30.1, window_az_px=10, window_el_px=30)
    marks = tick_marks(tick, place(40, 40, 40, 20))
    assert marks[10, 4].character == "+"
    assert (marks[6, 2].character, marks[14, 2].character) == ("┌", "┐")


def test_without_a_star_only_the_target_is_marked():
    state = shown(FakeSupervisor("ACQUISITION"))
    characters = {
        mark.character for mark in tick_marks(state.loop.tick, place(40, 40, 40, 20)).values()
    }
    assert characters == {"▔", "│"}


def test_an_ill_device_keeps_a_row_of_its_own_and_comes_first():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer in 1 s"}
    lines = plain(Devices(shown(supervisor)).draw(39, 2))
    assert lines[0].startswith("✗ piezo fault no answer in 1 s")
    assert lines[1].split() == ["✓", "camera", "✓", "siderostat", "✓", "D/A"]


def test_short_of_rows_the_well_devices_of_other_loops_are_left_out():
    supervisor = FakeSupervisor(loops=("right", "left"))
    supervisor.faulty = {"left piezo": "no answer in 1 s"}
    lines = plain(Devices(shown(supervisor)).draw(39, 2))
    assert lines[0].startswith("✗ left piezo fault")
    assert lines[1].split() == ["✓", "camera", "✓", "siderostat", "✓", "D/A", "✓", "piezo"]


def test_a_fault_is_told_in_full_where_there_is_room():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer in 1 s; check the cable, then Recover"}
    lines = plain(Devices(shown(supervisor)).draw(36, 8))
    told = " ".join(" ".join(lines).split())
    assert "no answer in 1 s; check the cable, then Recover" in told


def test_lost_records_take_the_recorders_line():
    supervisor = FakeSupervisor()
    supervisor.records_lost = 1234
    assert "✗ 1 234 RECORDS LOST" in plain(Timing(shown(supervisor)).draw(39, 3))[-1]


@pytest.mark.parametrize("rows", [3, 9])
def test_what_no_console_was_sent_stands_beside_the_other_counts(rows):
    supervisor = FakeSupervisor()
    assert "unsent" not in " ".join(plain(Timing(shown(supervisor)).draw(60, rows)))
    supervisor.ticks_unsent = 12
    assert "unsent 12!" in " ".join(plain(Timing(shown(supervisor)).draw(60, rows)))


def test_the_header_says_how_much_a_slow_console_missed():
    supervisor = FakeSupervisor()
    state = shown(supervisor)
    assert "missed" not in " ".join(plain(Header(state).draw(80, 3)))
    state.accept(supervisor.messages(5)[-1], state.now_s)
    assert "4 missed!" in " ".join(plain(Header(state).draw(80, 3)))


def test_a_long_event_is_wrapped_under_itself():
    event = Event(time_s=START_S, severity="error", source="D/A", message="no answer " * 8)
    lines = plain(event_lines(event, 0.0, 39))
    assert lines[0].startswith("00:00:00 ✗ D/A: no answer")
    assert all(line.startswith(" " * 11) for line in lines[1:])
    assert max(map(len, lines)) <= 39


def test_the_header_says_when_nothing_comes():
    state = shown(FakeSupervisor())
    state.now_s += 7.0
    assert "NO DATA for 7 s" in plain(Header(state).draw(80, 3))[2]


def tripped(name, since_s, **fields):
    told = {"action": "warn", "reset": "hand", "reason": f"interlock {name}: look at it"}
    return TrippedInterlock(name=name, since_s=since_s, **(told | fields))


def test_the_header_shows_what_is_tripped_how_many_there_are_and_how_to_reset_it():
    supervisor = FakeSupervisor()
    supervisor.interlocks = [tripped("disk_space", START_S), tripped("clock_step", START_S + 1)]
    line = plain(Header(shown(supervisor)).draw(120, 3))[2]

    assert "▲ clock_step warn +1  interlock clock_step: look at it; reset clock_step" in line


def test_what_resets_itself_asks_for_no_hand_and_a_short_line_is_cut():
    supervisor = FakeSupervisor()
    supervisor.interlocks = [tripped("flux_low", START_S, reset="itself", reason="far " * 60)]
    line = plain(Header(shown(supervisor)).draw(80, 3))[2]

    assert "flux_low warn  far far" in line
    assert "reset" not in line
    assert len(line.rstrip()) <= 80


def test_a_command_of_no_use_loses_its_cap():
    keys = Keys(shown(FakeSupervisor("SAFE"))).draw(80, 1)[0]
    capped = {segment.text.strip() for segment in keys if segment.style and segment.style.bgcolor}
    assert {"s STOP", "r", "o"} <= capped
    assert "a" not in capped


@pytest.mark.parametrize(
    ("query", "target"),
    [
        ("target 24 19.5", (24.0, 19.5)),
        ("TARGET -1,+2.25 ", (-1.0, 2.25)),
        ("target 24", None),
        ("target nan 3", None),
        ("standby", None),
    ],
)
def test_a_target_is_read_from_the_palette(query, target):
    command = parse_target(query)
    assert (command and (command.az_px, command.el_px)) == target
