"""A console of the whole testbed: a metrology loop among the stellar ones breaks no screen."""

import math

import numpy as np
import pytest
import scipy.special
from textual.actions import parse

from fitctl.messages.telemetry import FringeOptics, Telemetry
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import SCREENS
from fitctl.tui.loops.band import loop_rows
from fitctl.tui.loops.fringes import expected_visibility, fringe_line
from fitctl.tui.state import Rms
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.health import Devices
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.readings import DeviceList
from fitctl.tui.widgets.traces import Traces
from tests.instruments.fake_supervisor import STAR_LOST, TESTBED, FakeSupervisor
from tests.loop.test_link import Testbed
from tests.tui.drawn import changed_tick, plain, shown
from tests.tui.fixed import settle
from tests.tui.piloted import pressed, run
from tests.tui.wrong import faulty_testbed, link_lost, stopped_testbed


class Recorded:
    """Telemetry of the simulated testbed, twenty messages a second, until all loops hold."""

    def __init__(self):
        buffer, testbed = TelemetryBuffer(), Testbed()
        state = ServiceState(1, 0.0, "", lambda: 0, lambda: 0)
        self._messages: list[Telemetry] = []
        testbed.simulation._on_record = buffer.add
        testbed.simulation.acquire()
        while testbed.clock.now_s() < 20.0:
            testbed.run(0.05)
            state.sequence += 1
            now_s = testbed.clock.now_s()
            self._messages.append(buffer.telemetry(testbed.supervisor, state, now_s))

    def messages(self, _number):
        return self._messages


@pytest.fixture(scope="module")
def recorded():
    return Recorded()


@pytest.mark.long
def test_the_telemetry_carries_the_ticks_of_metrology_and_the_overlap(recorded):
    newest = recorded.messages(0)[-1]
    assert {loop.name: loop.kind for loop in newest.loops} == {
        "right": "stellar",
        "metrology": "metrology",
        "left": "stellar",
    }
    assert {tick.loop for tick in newest.ticks} == {"right", "left"}
    assert {tick.loop for tick in newest.metrology_ticks} == {"metrology"}
    assert newest.overlaps[-1].visibility > 0.8


@pytest.mark.long
@pytest.mark.parametrize("view", SCREENS, ids=lambda view: view.label)
def test_every_screen_shows_every_loop(recorded, view):
    shown = []

    async def scenario(app, pilot):
        await pressed(app, pilot, view.key)
        for _ in range(3):
            shown.append(app.state.loop.state.name)
            await pressed(app, pilot, "l")

    run(scenario, supervisor=recorded)
    assert sorted(shown) == ["left", "metrology", "right"]


def band(supervisor, columns=120):
    state = shown(supervisor)
    return plain(loop_rows(state, columns)), state


def test_on_a_broad_screen_all_loops_are_in_one_row_with_mode_time_and_part_of_requirement():
    (row,), _ = band(FakeSupervisor(loops=TESTBED))
    assert row.index("▸right") < row.index("metrology") < row.index("left")
    assert row.count("◆ VERNIER") == 2
    assert row.count("◉ LOCKED") == 1
    assert row.count(" % ✓") == 3
    assert row.count("2:15") == 3


def test_on_a_narrow_screen_each_loop_has_a_row_with_a_sparkline():
    rows, _ = band(FakeSupervisor(loops=TESTBED), 80)
    assert [row.split()[0].lstrip("▸") for row in rows] == list(TESTBED)
    for row in rows:
        assert len(row) == 80
        assert any("\u2801" <= sign <= "\u28ff" for sign in row)


def test_the_band_says_who_stopped_and_what_failed_and_what_a_loop_waits_for():
    (stopped,), _ = band(stopped_testbed(), 200)
    assert stopped.count("■ SAFE") == 3
    assert stopped.count("stopped by anna") == 3
    (failed,), _ = band(faulty_testbed(), 200)
    assert "✗ SAFE" in failed
    assert "fault" in failed
    (waiting,), _ = band(link_lost(), 200)
    assert "waits: metrology" in waiting


@pytest.mark.parametrize(
    ("columns", "lost"), [(200, "▲ star lost"), (120, "▲ lost"), (112, "▲ lost")]
)
def test_a_lost_star_is_a_lost_star_in_a_narrow_band(columns, lost):
    supervisor = FakeSupervisor(loops=TESTBED, modes={"right": "ACQUISITION"})
    supervisor.search_again = STAR_LOST
    (row,) = plain(loop_rows(shown(supervisor), columns))
    assert f"{lost} " in row.partition("metrology")[0]


@pytest.mark.parametrize(("columns", "stopped"), [(200, "stopped by anna"), (105, " by anna")])
def test_who_stopped_the_loops_is_whole_in_a_narrow_band(columns, stopped):
    (row,) = plain(loop_rows(shown(stopped_testbed()), columns))
    assert row.count(stopped) == 3


def test_what_a_search_passes_over_is_no_rms():
    supervisor = FakeSupervisor(loops=TESTBED, modes={"right": "ACQUISITION"})
    headings = [
        line for line in plain(Traces(shown(supervisor)).draw(78, 21)) if "◎" in line or "◆" in line
    ]
    assert ["RMS" in heading for heading in headings] == [False, True]


def test_spots_of_two_loops_with_one_name_have_it_once():
    state = shown(FakeSupervisor(loops=TESTBED))
    changed_tick(state, star_az_px=25.0)  # its fringe spot is 3 px from that of the left loop
    picture = "\n".join(plain(FocalPlane(state).draw(40, 21)))
    assert picture.count("◦") == 3  # a ring for each loop's, and the legend
    assert picture.count("fringe") == 2


def test_old_modes_are_said_to_be_old():
    state = shown(FakeSupervisor(loops=TESTBED))
    state.now_s += 7.2
    (row,) = plain(loop_rows(state, 200))
    assert row.count("VERNIER, 7 s ago") == 2
    assert "LOCKED, 7 s ago" in row
    assert "✓" not in row


def test_the_error_of_a_metrology_loop_is_drawn_in_arcseconds_beside_round_labels():
    state = shown(FakeSupervisor(loops=("metrology",)), 400)
    lines = plain(Traces(state).draw(90, 21))
    assert "″ = " in lines[0]
    assert "of 1 ″ ✓" in lines[0]
    assert {line[:5].strip() for line in lines[1:10]} >= {"+2", "+1", "0", "−1", "−2"}
    assert any("\u2801" <= sign <= "\u28ff" for sign in lines[5])


def test_all_loops_are_traced_on_one_time_axis():
    state = shown(FakeSupervisor(loops=TESTBED), 400)
    lines = plain(Traces(state).draw(78, 21))
    headings = [line for line in lines if " RMS of " in line]
    assert [line.split()[0].lstrip("▸") for line in headings] == list(TESTBED)
    assert len(lines) == 21
    assert lines[-1].rstrip().endswith("now")
    assert sum("now" in line for line in lines) == 1


def test_the_time_axis_of_old_data_does_not_say_now():
    state = shown(FakeSupervisor(), 400)
    state.now_s += 7.2
    lines = plain(Traces(state).draw(78, 21))
    assert lines[-1].rstrip().endswith("7 s ago")
    assert "now" not in lines[-1]


def test_the_time_axis_of_the_past_ends_at_its_time():
    state = shown(FakeSupervisor(), 400)
    state.live = False
    for silent_s in (0.0, 7.2):
        state.now_s = state.received_s + silent_s
        axis = plain(Traces(state).draw(78, 21))[-1]
        assert axis.rstrip().endswith(" 07:00:20 UTC")
        assert "now" not in axis


@pytest.mark.parametrize("columns", [20, 26, 30, 40])
def test_the_name_of_a_window_is_whole_on_a_frame_of_any_size(columns):
    state = shown(FakeSupervisor(loops=TESTBED))
    picture = "\n".join(plain(FocalPlane(state).draw(columns, columns // 2 + 1)))
    assert "left" in picture
    assert "right" in picture


def test_every_window_is_named():
    state = shown(FakeSupervisor(loops=TESTBED))
    picture = "\n".join(plain(FocalPlane(state).draw(40, 21)))
    assert "┌left" in picture
    assert "┌right" in picture


def test_the_fringe_line_has_visibility_expectation_and_tilt():
    state = shown(FakeSupervisor(loops=TESTBED), 400)
    line = plain([fringe_line(state, 80)])[0]
    visibility, expected = (float(line.split(word)[1].split()[0]) for word in ("V ", "expected "))
    assert 0.9 < visibility <= 1.0
    assert expected == pytest.approx(visibility, abs=0.03)
    assert "tilt az el" in line


def test_without_both_stars_there_is_no_visibility():
    state = shown(stopped_testbed(), 50)
    assert "both loops must hold a star" in plain([fringe_line(state, 80)])[0]


@pytest.mark.parametrize("rms_px", [0.02, 0.05, 0.07])
def test_the_expected_visibility_is_the_mean_over_the_pointing_errors(rms_px):
    optics = FringeOptics(loops=("left", "right"), aperture_m=0.15, wavelength_m=700e-9)
    rms = Rms(rms_px, rms_px, 10.0)
    errors_px = np.random.default_rng(1).normal(0.0, rms_px, (4, 200_000))
    tilt_arcsec = 2.708 * np.hypot(errors_px[0] - errors_px[1], errors_px[2] - errors_px[3])
    x = math.pi * 0.15 / 700e-9 * tilt_arcsec / 206264.8
    mean = float(np.mean(2 * scipy.special.j1(x) / x))
    assert expected_visibility(optics, rms, rms, 2.708) == pytest.approx(mean, abs=0.01)


def test_events_have_their_loop_in_a_column():
    state = shown(FakeSupervisor(loops=TESTBED))
    lines = plain(Events(state).draw(100, 20))
    column = lines[0].index("COARSE")
    assert all(line[column - 1] == " " for line in lines if "->" in line)
    assert any(line[11:].startswith("metrology  COARSE -> LOCKED") for line in lines)
    assert any(line[11:].lstrip().startswith("supervisor: opening") for line in lines)


def test_ill_devices_come_before_healthy_ones():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer"}
    state = shown(supervisor)
    assert plain(Devices(state).draw(60, 8))[0].startswith("✗ piezo")
    assert DeviceList(state).devices()[0].device == "right piezo"


@pytest.mark.long
def test_a_click_on_a_loop_chooses_it():
    async def scenario(app, pilot):
        row = app.view.query_one("#header").render_line(1).text
        await pilot.click("#header", offset=(row.index("left"), 1))
        await settle(app, pilot)
        assert app.state.shown == "left"

    run(scenario, supervisor=FakeSupervisor(loops=TESTBED))


def test_a_click_names_the_loop_also_where_a_supervisor_names_it_oddly():
    state = shown(FakeSupervisor(loops=("right", "it's")))
    for lines in (loop_rows(state, 120), Traces(state).draw(80, 20)):
        actions = {part.style.meta.get("@click") for line in lines for part in line if part.style}
        assert {parse(action)[2] for action in actions if action} == {("right",), ("it's",)}


def test_the_footer_says_which_loop_a_command_goes_to_and_that_stop_is_for_all():
    footer = plain(keys_of_footer(shown(FakeSupervisor(loops=TESTBED))))[0]
    assert footer.startswith(" s STOP all ")
    assert "right h Release" in footer
    single = plain(keys_of_footer(shown(FakeSupervisor())))[0]
    assert "STOP all" not in single


def keys_of_footer(state):
    return Keys(state, "operate", AlarmBook()).draw(120, 1)
