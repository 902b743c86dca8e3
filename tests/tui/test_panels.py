import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
import scipy.signal

from fitctl.logging.records import Event
from fitctl.supervisor.messages import Look, SequenceStatus, SetTarget, TrippedInterlock
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import VIEWS, keys_of
from fitctl.tui.draw.frame import place
from fitctl.tui.jog import JogPad
from fitctl.tui.palette import parse_place
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.alarmbar import AlarmBar
from fitctl.tui.widgets.events import Events, event_lines
from fitctl.tui.widgets.focalplane import FocalPlane, spot_marks, tick_marks
from fitctl.tui.widgets.hand import Hand
from fitctl.tui.widgets.header import Header
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.loglist import LogList
from fitctl.tui.widgets.margins import Margins
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.readings import DeviceList, Readings, in_units
from fitctl.tui.widgets.sequencing import Parameters, Progress, SequenceList
from fitctl.tui.widgets.spectrum import Spectrum, spectra_of
from fitctl.tui.widgets.stages import Stages, working_point
from fitctl.tui.widgets.timing import Breakdown, Histograms
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
    state.loop.tick = msgspec.structs.replace(state.loop.tick, **fields)
    return state.loop.tick


def header(state):
    return Header(state, "operate")


def keys(state):
    return Keys(state, "operate")


def alarm_bar(state):
    book = AlarmBook()
    book.judge(state)
    return AlarmBar(state, book)


def hand(state):
    return Hand(state, JogPad())


def parameters(state):
    sequences = SequenceList(state, "")
    sequences.documents = [
        {
            "file": "jog.toml",
            "name": "jog",
            "description": "A jog.",
            "steps": [{"step": "off", "loop": ""}],
        }
    ]
    return Parameters(state, "", sequences)


def sequence_list(state):
    return parameters(state)._sequences


def log_list(state):
    return LogList(state, "", Path("no such folder"))


def printed(state):
    return Printed(state, "", "Choose something. " * 20)


PANELS = (
    header,
    alarm_bar,
    keys,
    hand,
    FocalPlane,
    Traces,
    Stages,
    Devices,
    Timing,
    Events,
    DeviceList,
    Readings,
    Histograms,
    Breakdown,
    Spectrum,
    Margins,
    sequence_list,
    parameters,
    Progress,
    printed,
    log_list,
)
MODES = ["OFF", "STANDBY", "ACQUISITION", "COARSE", "VERNIER", "SAFE", "EXPERIMENT"]


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [(39, 3), (80, 20), (3, 1), (200, 60)])
def test_every_panel_draws_in_every_mode_and_size(panel, mode, size):
    panel(shown(FakeSupervisor(mode))).draw(*size)


@pytest.mark.parametrize("panel", PANELS)
def test_every_panel_draws_before_anything_came(panel):
    panel(ConsoleState(START_S)).draw(80, 20)


@pytest.mark.parametrize("panel", [header, FocalPlane, Traces, Stages, Devices, Timing, keys])
@pytest.mark.parametrize("mode", ["ACQUISITION", "VERNIER"])
def test_nothing_is_wider_than_its_panel_at_80_columns(panel, mode):
    columns, rows = {
        header: (80, 3),
        FocalPlane: (40, 20),
        Traces: (39, 8),
        Stages: (39, 4),
        Devices: (39, 2),
        Timing: (39, 3),
        keys: (80, 1),
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
        span_s=20.0,
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


def test_a_fringe_spot_is_marked_on_its_light_and_named_in_the_caption():
    state = shown(FakeSupervisor())
    frame, placing = state.newest.frame, place(40, 40, 40, 20)
    ((column, row),) = spot_marks(state.loop, placing)
    az_px, el_px = placing.pixel(column, row)
    image = np.frombuffer(frame.data, "<u2").reshape(40, 40).astype(int)
    near = image[round(el_px) - 1 : round(el_px) + 2, round(az_px) - 1 : round(az_px) + 2]
    assert near.sum() - 9 * np.median(image) > 0.5 * 11_000

    caption = plain(FocalPlane(state).draw(40, 21))[-1]
    assert "◦ fringe" in caption
    assert "star" in caption


def test_without_a_star_no_other_spot_is_marked():
    assert not spot_marks(shown(FakeSupervisor("ACQUISITION")).loop, place(40, 40, 40, 20))


def test_what_has_no_room_in_the_caption_is_the_light_and_not_a_spots_name():
    state = shown(FakeSupervisor())
    changed_tick(state, star_flux_dn=1_234_567.0)
    caption = plain(FocalPlane(state).draw(40, 21))[-1]
    assert "◦ fringe" in caption
    assert "DN" not in caption


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


def test_a_long_name_of_the_commander_gives_way_to_the_state_of_the_link():
    supervisor = FakeSupervisor()
    message = supervisor.messages(1)[-1]
    for columns in (80, 100, 120):
        state = shown(supervisor)
        named = msgspec.structs.replace(message, commander="somebody@" + "far-away." * 9)
        state.accept(named, state.now_s)
        head = " ".join(plain(Header(state, "operate").draw(columns, 3)))
        assert "live" in head
        assert "UTC" in head


def test_the_header_says_how_much_a_slow_console_missed():
    supervisor = FakeSupervisor()
    state = shown(supervisor)
    assert "missed" not in " ".join(plain(Header(state, "operate").draw(80, 3)))
    state.accept(supervisor.messages(5)[-1], state.now_s)
    assert "4 missed!" in " ".join(plain(Header(state, "operate").draw(80, 3)))


def test_a_long_event_is_wrapped_under_itself():
    event = Event(time_s=START_S, severity="error", source="D/A", message="no answer " * 8)
    lines = plain(event_lines(event, 0.0, 39))
    assert lines[0].startswith("00:00:00 ✗ D/A: no answer")
    assert all(line.startswith(" " * 11) for line in lines[1:])
    assert max(map(len, lines)) <= 39


def test_the_footer_has_stop_and_what_can_be_done_now_and_nothing_else():
    line = plain(keys(shown(FakeSupervisor("SAFE"))).draw(160, 1))[0]
    assert line.startswith(" s STOP ")
    assert "r Recover" in line
    assert "o Off" in line
    assert "Acquire" not in line
    assert "? Help" in line


def test_a_narrow_footer_keeps_stop_the_commands_and_help():
    line = plain(keys(shown(FakeSupervisor("SAFE"))).draw(40, 1))[0]
    assert all(word in line for word in ("s STOP", "r Recover", "o Off", "? Help"))
    assert len(line.rstrip()) <= 41


@pytest.mark.parametrize("view", [view.name for view in VIEWS])
def test_every_key_of_a_screen_is_clicked_as_it_is_pressed(view):
    line = Keys(shown(FakeSupervisor()), view).draw(300, 1)[0]
    actions = {segment.style.meta.get("@click") for segment in line if segment.style}
    wanted = {
        key.action for key in keys_of(view) if key.action and key.matters(shown(FakeSupervisor()))
    }
    assert wanted <= actions
    assert "app.command('Stop')" in actions


def test_the_header_leads_to_every_screen_by_mouse():
    for columns in (80, 120):
        lines = Header(shown(FakeSupervisor()), "loop").draw(columns, 3)
        actions = {s.style.meta.get("@click") for line in lines for s in line if s.style}
        assert {f"app.view('{view.name}')" for view in VIEWS} <= actions


def test_a_reading_out_of_its_range_changes_its_sign():
    supervisor = FakeSupervisor()
    before = plain(Readings(shown(supervisor)).draw(100, 20))
    supervisor.interlocks = [
        TrippedInterlock(
            name="dac_slow", since_s=START_S, action="warn", reset="itself", reason="slow; wait"
        )
    ]
    after = plain(Readings(shown(supervisor)).draw(100, 20))
    row = next(number for number, line in enumerate(after) if "dac_slow" in line)
    assert before[row].lstrip("▌ ").startswith("✓ dac_slow")
    assert after[row].lstrip("▌ ").startswith("▲ dac_slow")


@pytest.mark.parametrize(
    ("quantity", "value", "told"),
    [
        ("frame_late_s", 0.0004, "0.0004 s"),
        ("fsm_range_fraction", 0.314, "31.4 %"),
        ("disk_free_bytes", 8.1e10, "81 GB"),
        ("amplifier_round_trip_periods", 0.21, "0.21 periods"),
        ("amplifier_fault", 1.0, "1"),
        ("piezo_limit_error_v", -0.5, "−0.5 V"),
        ("dac_unwritten_s", None, ""),
    ],
)
def test_readings_are_told_in_the_units_of_their_names(quantity, value, told):
    assert in_units(quantity, value) == told


def test_a_list_scrolls_to_what_is_chosen():
    readings = Readings(shown(FakeSupervisor()))
    readings.draw(80, 4)
    for wanted in (6, 0, 7):
        readings.chosen = wanted
        lines = plain(readings.draw(80, 4))
        assert len(lines) == 4
        chosen = [line for line in lines if line.startswith("▌")]
        assert len(chosen) == 1
        assert readings.watched()[wanted].name in chosen[0]


def test_the_siderostat_is_told_with_its_limits_and_warned_of_near_them():
    state = shown(FakeSupervisor())
    assert "of ±600″" in "".join(plain(Stages(state).draw(100, 9)))
    changed_tick(state, siderostat_az_sky_arcsec=590.0)
    assert "″!" in "".join(plain(Stages(state).draw(100, 9)))


def test_the_search_has_its_map_with_the_way_and_the_field():
    lines = plain(Traces(shown(FakeSupervisor("ACQUISITION"), 400)).draw(76, 20))
    told = "\n".join(lines)
    assert "searched 37 %" in told
    assert "field, 108″" in told
    assert "radius 215″" in told


def test_the_spectrum_has_a_line_where_the_error_has_one():
    times_s = np.arange(0, 20, 0.02)
    tone = np.sqrt(2) * 0.05 * np.sin(2 * np.pi * 4.0 * times_s)
    spectra = spectra_of(scipy.signal, np.column_stack([times_s, tone, 0 * tone]))
    peak_hz = spectra.frequency_hz[np.argmax(spectra.density_px_per_sqrt_hz[:, 0])]
    assert peak_hz == pytest.approx(4.0, abs=0.2)
    step_hz = np.diff(spectra.frequency_hz)[0]
    rms_px = np.sqrt(np.sum(spectra.density_px_per_sqrt_hz**2, axis=0) * step_hz)
    assert rms_px == pytest.approx([0.05, 0.0], abs=0.003)


def test_the_spectrum_is_of_the_ticks_since_the_star_was_missed():
    errors = np.column_stack([np.arange(200) * 0.02, np.zeros((200, 2))])
    errors[150, 1:] = math.nan
    assert spectra_of(scipy.signal, errors) is None
    errors[150, 1:] = 0.0
    errors[20, 1:] = math.nan
    assert spectra_of(scipy.signal, errors) is not None


def test_margins_are_judged_against_what_is_usual():
    margins = Margins(shown(FakeSupervisor(), 400))
    told = {
        "stable": True,
        "crossover_hz": 3.9,
        "phase_margin_deg": 22.7,
        "gain_margin_db": 7.1,
        "peak_sensitivity": 1.9,
        "attenuation_1hz": 6.1,
        "residual_px": 0.0131,
    }
    margins.told("minimum-variance", json.dumps(told), 0)
    lines = plain(margins.draw(60, 12))
    assert next(line for line in lines if "phase" in line).endswith("▲")
    assert next(line for line in lines if "gain" in line).endswith("✓")
    assert any("0.0131 px, by linear theory" in line for line in lines)
    margins.told("minimum-variance", "design: no such loop", 2)
    assert "✗ design: no such loop" in "\n".join(plain(margins.draw(60, 12)))


def test_the_tick_is_broken_down_into_parts_that_make_up_the_whole():
    state = shown(FakeSupervisor(), 400)
    lines = plain(Breakdown(state).draw(100, 8))
    median = {line.split()[0]: float(line.split()[1]) for line in lines[1:]}
    whole = median["sense"] + median["decide"] + median["write"]
    assert whole == pytest.approx(median["tick"], abs=0.02)


def test_a_sequence_under_way_is_told_with_its_step_and_what_is_asked_of_it():
    supervisor = FakeSupervisor()
    supervisor.running_sequence = SequenceStatus(
        run="1", name="jog", state="running", steps=3, step_number=2, step="hold", wanted="pause"
    )
    told = "\n".join(plain(Progress(shown(supervisor)).draw(90, 2)))
    assert "▶ jog running; asked to pause" in told
    assert "step 2/3 hold" in told


@pytest.mark.parametrize(
    ("query", "command"),
    [
        ("target 24 19.5", SetTarget(az_px=24.0, el_px=19.5)),
        ("TARGET -1,+2.25 ", SetTarget(az_px=-1.0, el_px=2.25)),
        ("look 12 20", Look(az_px=12.0, el_px=20.0)),
        ("target 24", None),
        ("look nan 3", None),
        ("standby", None),
    ],
)
def test_a_place_is_read_from_the_palette(query, command):
    found = parse_place(query)
    assert (found and found[1]) == command
