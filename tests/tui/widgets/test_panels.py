import json
from pathlib import Path

import msgspec
import pytest

from fitctl.logging.records import Event
from fitctl.messages.commands import LearnerReport, Look, SequenceStatus, SetTarget
from fitctl.messages.telemetry import LearningState, TrippedInterlock
from fitctl.tui.alarms import AlarmBook, counts
from fitctl.tui.commands import OPERATOR_COMMANDS, SCREENS, VIEWS, keys_of
from fitctl.tui.jog import JogPad
from fitctl.tui.palette import parse_place
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.alarmbar import AlarmBar
from fitctl.tui.widgets.events import Events, event_lines
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.hand import Hand
from fitctl.tui.widgets.header import Header
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.loglist import LogList
from fitctl.tui.widgets.margins import DesignFigures, Margins, design_in_use
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.readings import DeviceList, Readings, in_units
from fitctl.tui.widgets.sequencing import Parameters, Progress, SequenceList
from fitctl.tui.widgets.spectrum import ErrorBudget, Spectrum
from fitctl.tui.widgets.stages import Stages
from fitctl.tui.widgets.timing import Breakdown, Histograms
from fitctl.tui.widgets.traces import Traces
from tests.instruments.fake_supervisor import STAR_LOST, START_S, FakeSupervisor
from tests.tui.drawn import plain, shown
from tests.tui.fixed import DESIGN


def header(state):
    return Header(state, "operate", updated_book(state))


def keys(state):
    return Keys(state, "operate", updated_book(state))


def updated_book(state):
    book = AlarmBook()
    book.update(state)
    return book


def alarm_bar(state):
    return AlarmBar(state, updated_book(state))


def hand(state):
    return Hand(state, JogPad())


def parameters(state):
    sequences = SequenceList(state, "")
    sequences.documents = [
        {
            "file": "jog.toml",
            "name": "dither",
            "description": "A jog.",
            "steps": [{"step": "off", "loop": ""}],
        }
    ]
    return Parameters(state, "", sequences)


def sequence_list(state):
    return parameters(state)._sequences


def log_list(state):
    return LogList(state, "", Path("no such folder"))


def evaluated(state):
    """What `fitctl design` printed of the design in use."""
    figures = DesignFigures()
    if state.loop is not None:
        figures.accept(design_in_use(state.loop.state), json.dumps(DESIGN), 0)
    return figures


def margins(state):
    return Margins(state, "", evaluated(state), lambda _loop: "")


def spectrum(state):
    return Spectrum(state, "", evaluated(state))


def error_budget(state):
    return ErrorBudget(state, "", evaluated(state))


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
    spectrum,
    error_budget,
    margins,
    sequence_list,
    parameters,
    Progress,
    printed,
    log_list,
)


MODES = ["OFF", "STANDBY", "ACQUISITION", "COARSE", "VERNIER", "SAFE", "EXPERIMENT"]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [(39, 3), (80, 20), (3, 1), (200, 60)])
def test_every_panel_draws_in_every_mode_and_size(mode, size):
    state = shown(FakeSupervisor(mode))
    for panel in PANELS:
        panel(state).draw(*size)


def test_every_panel_draws_before_anything_came():
    for panel in PANELS:
        panel(ConsoleState(START_S)).draw(80, 20)


@pytest.mark.parametrize("mode", ["ACQUISITION", "VERNIER"])
def test_nothing_is_wider_than_its_panel_at_80_columns(mode):
    state = shown(FakeSupervisor(mode), 450)
    for panel, columns, rows in (
        (header, 80, 3),
        (FocalPlane, 40, 20),
        (Traces, 39, 9),
        (Stages, 39, 4),
        (Devices, 39, 2),
        (Timing, 39, 3),
        (keys, 80, 1),
    ):
        lines = plain(panel(state).draw(columns, rows))
        assert len(lines) <= rows, panel
        assert max(len(line.rstrip()) for line in lines) <= columns, panel


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


def test_a_fault_that_is_longer_uses_the_rows_that_there_are():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer in 1 s; " + "check the cable and its plug " * 9}
    lines = plain(Devices(shown(supervisor)).draw(36, 6))
    assert "".join(line[0] for line in lines) == "✗  ✓✓✓"
    assert lines[2].endswith("…")


def test_faults_come_before_closed_devices_and_share_the_rows():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer in 1 s; " + "x " * 60, "right D/A": "y " * 60}
    state = shown(supervisor)
    camera, *others = state.newest.devices
    devices = [msgspec.structs.replace(camera, state="closed"), *others]
    state.newest = msgspec.structs.replace(state.newest, devices=devices)
    lines = plain(Devices(state).draw(36, 8))
    assert "".join(line[0] for line in lines) == "✗  ✗  ○✓"


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


@pytest.mark.parametrize("rows", [3, 9])
def test_where_there_is_no_room_for_all_counts_those_that_are_not_zero_are_whole(rows):
    supervisor = FakeSupervisor()
    state = shown(supervisor)
    loop = state.loops["right"]
    loop.timing = msgspec.structs.replace(loop.timing, late_ticks=5, servo_missed=13, stalls=1234)
    printed = " ".join(plain(Timing(state).draw(39, rows)))
    for count in ("late 5!", "miss 13!", "stall 1234!"):
        assert count in printed
    printed = " ".join(plain(Timing(state).draw(29, rows)))
    assert "stall 1234!" in printed
    assert "lost 0" not in printed


def test_a_long_name_of_the_commander_gives_way_to_the_state_of_the_link():
    supervisor = FakeSupervisor()
    message = supervisor.messages(1)[-1]
    for columns in (80, 100, 120):
        state = shown(supervisor)
        named = msgspec.structs.replace(message, commander="somebody@" + "far-away." * 9)
        state.accept(named, state.now_s)
        head = " ".join(plain(header(state).draw(columns, 3)))
        assert "live" in head
        assert "UTC" in head


def test_the_header_says_how_much_a_slow_console_missed():
    supervisor = FakeSupervisor()
    state = shown(supervisor)
    assert "missed" not in " ".join(plain(header(state).draw(80, 3)))
    state.accept(supervisor.messages(5)[-1], state.now_s)
    assert "▲ 4 missed" in " ".join(plain(header(state).draw(80, 3)))


@pytest.mark.parametrize("columns", [80, 160])
def test_the_header_says_that_the_star_was_lost(columns):
    supervisor = FakeSupervisor("ACQUISITION")
    assert "star lost" not in "\n".join(plain(header(shown(supervisor)).draw(columns, 3)))

    supervisor.search_again = STAR_LOST

    assert "star lost" in "\n".join(plain(header(shown(supervisor)).draw(columns, 3)))


def test_the_map_of_a_search_for_a_lost_star_is_as_wide_as_its_round():
    supervisor = FakeSupervisor("ACQUISITION")
    supervisor.search_again = STAR_LOST

    assert "radius 107.5″" in "\n".join(plain(Traces(shown(supervisor)).draw(100, 20)))


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


@pytest.mark.parametrize("mode", MODES)
def test_at_80_columns_an_alarms_keys_follow_stop_and_the_commands(mode):
    supervisor = FakeSupervisor(mode)
    supervisor.records_lost = 3
    state = shown(supervisor)
    book = updated_book(state)
    footer = Keys(state, "operate", book)
    line = plain(footer.draw(80, 1))[0]
    commands = [row.label for row in OPERATOR_COMMANDS if row.name in state.usable_commands]
    wanted = [*commands, "Acknowledge", "Silence", "Alarms", "Help"]
    places = [line.index(word) for word in wanted]
    assert places == sorted(places)
    book.silence()
    line = plain(footer.draw(80, 1))[0]
    assert "Silence" not in line
    assert "Acknowledge" in line
    book.acknowledge(counts(book.in_order))
    line = plain(footer.draw(80, 1))[0]
    assert "Acknowledge" not in line
    assert "Alarms" not in line


def test_a_narrow_footer_keeps_stop_the_commands_and_help():
    line = plain(keys(shown(FakeSupervisor("SAFE"))).draw(40, 1))[0]
    assert all(word in line for word in ("s STOP", "r Recover", "o Off", "? Help"))
    assert len(line.rstrip()) <= 41


@pytest.mark.parametrize("view", [view.name for view in VIEWS])
def test_every_key_of_a_screen_is_clicked_as_it_is_pressed(view):
    state = shown(FakeSupervisor())
    line = Keys(state, view, AlarmBook()).draw(300, 1)[0]
    actions = {segment.style.meta.get("@click") for segment in line if segment.style}
    wanted = {key.action for key in keys_of(view) if key.action and key.matters(state, AlarmBook())}
    assert wanted <= actions
    assert "app.command('Stop')" in actions


@pytest.mark.parametrize(("waits_for_supervisor", "views"), [(True, VIEWS), (False, SCREENS)])
def test_the_header_leads_to_every_screen_by_mouse(waits_for_supervisor, views):
    for columns in (80, 120):
        state = shown(FakeSupervisor())
        state.waits_for_supervisor = waits_for_supervisor  # a console for commissioning does not
        lines = Header(state, "loop", AlarmBook()).draw(columns, 3)
        actions = {s.style.meta.get("@click") for line in lines for s in line if s.style}
        screens = {action for action in actions if action and action.startswith("app.view(")}
        assert screens == {f"app.view('{view.name}')" for view in views}


def test_a_reading_out_of_its_range_changes_its_sign():
    supervisor = FakeSupervisor()
    before = plain(Readings(shown(supervisor)).draw(100, 20))
    supervisor.interlocks = [
        TrippedInterlock(
            name="dac_slow", since_s=START_S, action="warn", reset="itself", reason="slow; wait"
        )
    ]
    after = plain(Readings(shown(supervisor)).draw(100, 20))
    was, becomes = (next(line for line in lines if "dac_slow" in line) for lines in (before, after))
    assert was.lstrip("▌▏ ").startswith("✓ dac_slow")
    assert becomes.lstrip("▌▏ ").startswith("▲ dac_slow")


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
    readings.set_reactive(Readings.has_focus, True)
    readings.draw(80, 4)
    for wanted in (6, 0, 7):
        readings.chosen = wanted
        lines = plain(readings.draw(80, 4))
        assert len(lines) == 4
        chosen = [line for line in lines if line.startswith("▌")]
        assert len(chosen) == 1
        assert readings.watched()[wanted].name in chosen[0]


def test_a_sequence_under_way_is_told_with_its_step_and_what_is_asked_of_it():
    supervisor = FakeSupervisor()
    supervisor.running_sequence = SequenceStatus(
        run="1", name="dither", state="running", steps=3, step_number=2, step="hold", wanted="pause"
    )
    told = "\n".join(plain(Progress(shown(supervisor)).draw(90, 2)))
    assert "▶ dither running; asked to pause" in told
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


# ---------------------------------------------------------------- what was learnt


def learnt(state, fits=True, **values):
    report = LearnerReport(
        loop="right",
        design_json="{}",
        text="a line at 6 Hz",
        evaluated_s=60.0,
        present_px=0.1,
        learnt_px=0.024,
        fits=fits,
    )
    return LearningState(setting="on", state=state, text="a line at 6 Hz", report=report, **values)


@pytest.mark.parametrize(
    ("learning", "expected"),
    [
        (LearningState(setting="advise", state="collecting"), ["collecting frames in VERNIER"]),
        (learnt("kept"), ["no other design would leave clearly less", "a line at 6 Hz"]),
        (learnt("kept", fits=False), ["the model does not explain the frames: kept"]),
        (
            learnt("advice"),
            ["0.0240 px instead of 0.1000", "fitctl send controller learnt --loop right"],
        ),
        (
            learnt("in force", design_json="{}", expected_px=0.026, measured_px=0.027),
            ["on frames 0.0270 px, expected 0.0260"],
        ),
        (
            learnt(
                "in force",
                design_json="{}",
                expected_px=0.026,
                measured_px=0.027,
                before_px=0.098,
            ),
            ["before        0.0980 px on the same frames"],
        ),
        (learnt("failed"), ["nothing could be learnt", "a line at 6 Hz"]),
        (learnt("fell back"), ["returned to the previous design"]),
    ],
    ids=lambda value: getattr(value, "state", ""),
)
def test_the_design_panel_shows_what_was_learnt(learning, expected):
    supervisor = FakeSupervisor()
    supervisor.learning = learning
    drawn_lines = plain(margins(shown(supervisor)).draw(70, 12))
    assert drawn_lines[1].startswith("learning")
    for part in expected:
        assert any(part in line for line in drawn_lines), part


def test_a_loop_that_does_not_learn_has_no_row_for_it():
    supervisor = FakeSupervisor()
    supervisor.learning = LearningState(setting="off", state="collecting")
    assert not any("learning" in line for line in plain(margins(shown(supervisor)).draw(70, 12)))
