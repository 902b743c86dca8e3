"""What is drawn of numbers: the focal plane's marks, traces, the diamond, the search, spectrum and margins."""

import json
import math
import re

import msgspec
import numpy as np
import pytest

from fitctl.error_budget import theory_to_plain
from fitctl.tui.draw.frame import place
from fitctl.tui.draw.overlays import Overlay, cell_marks, tick_overlays
from fitctl.tui.history import Past
from fitctl.tui.inks import AZ, EL, PINK, WHITE
from fitctl.tui.state import TICK_FIELDS
from fitctl.tui.widgets.focalplane import FocalPlane, spot_overlays
from fitctl.tui.widgets.margins import DesignFigures, DesignInUse, Margins, design_in_use
from fitctl.tui.widgets.spectrum import ErrorBudget, Spectrum, _limits, loop_spectra
from fitctl.tui.widgets.stages import Stages, working_point
from fitctl.tui.widgets.timing import Breakdown
from fitctl.tui.widgets.traces import Traces, axis_limit, trace_lines
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.drawn import changed_tick, plain, shown
from tests.tui.fixed import theory_of


@pytest.mark.parametrize(
    ("worst_px", "limit"),
    [(0.0, 0.2), (0.15, 0.2), (0.3, 0.5), (0.99, 2.0), (7.0, 10.0), (19, 20)],
)
def test_the_scale_is_a_sensible_step_that_holds_all_and_shows_the_band(worst_px, limit):
    assert axis_limit(np.array([worst_px, math.nan]), 0.1) == pytest.approx(limit)


def test_the_scale_without_a_star_is_twice_the_requirement():
    assert axis_limit(np.full(4, math.nan), 0.25) == pytest.approx(0.5)


def test_the_trace_has_its_scale_beside_it():
    lines = trace_lines(
        np.array([1.0]),
        np.array([0.0]),
        now_s=1.0,
        span_s=20.0,
        limit=0.2,
        requirement=0.1,
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


def test_the_window_is_where_the_tick_says():
    state = shown(FakeSupervisor())
    tick = changed_tick(state, star_az_px=10.2, star_el_px=30.1, window_az_px=10, window_el_px=30)
    marks = cell_marks(tick_overlays(tick), place(40, 40, 40, 20))
    assert (marks[6, 2].character, marks[14, 2].character) == ("┌", "┐")


@pytest.mark.parametrize("zoom", [1, 2])
def test_the_cross_points_at_the_centroid_within_a_quarter_of_a_cell(zoom):
    placing = place(40, 40, 40 * zoom, 20 * zoom)
    for az_px, el_px in np.random.default_rng(2).uniform(10.0, 30.0, (200, 2)):
        marks = cell_marks([Overlay("centroid", az_px, el_px, "")], placing)
        (left, row), (right, other_row) = sorted(c for c in marks if marks[c].character in "⠉⠒⠤⣀")[
            ::3
        ]
        ((column, _), *_) = (c for c in marks if marks[c].character in "⡇⢸")
        assert row == other_row
        assert (left, right) == (column - 2, column + 2)
        pointed_row = row + ("⠉⠒⠤⣀".index(marks[left, row].character) + 0.5) / 4
        pointed_column = column + ("⡇⢸".index(marks[column, row - 1].character) + 0.5) / 2
        assert (
            abs(pointed_column - placing.column(az_px)) <= 0.25 + 1e-9
        )  # a quarter of a cell: 0.25 px
        assert abs(pointed_row - placing.row(el_px)) <= 0.125 + 1e-9  # of two pixels: 0.25 px too


def test_the_cross_leaves_the_star_s_middle_free():
    placing = place(40, 40, 40, 20)
    marks = cell_marks([Overlay("centroid", 20.2, 19.7, "")], placing)
    assert (math.floor(placing.column(20.2)), math.floor(placing.row(19.7))) not in marks


@pytest.mark.parametrize(
    ("az_px", "el_px", "begin", "below"), [(8, 19, -3, 2), (39, 19, -5, 2), (0, 0.5, 0, -2)]
)
def test_a_spot_has_its_name_below_it_or_above_at_the_edge(az_px, el_px, begin, below):
    marks = cell_marks([Overlay("spot", az_px, el_px, PINK, "fringe")], place(40, 40, 40, 20))
    column, row = next(cell for cell in marks if marks[cell].character == "◦")
    named = (marks[column + begin + n, row + below].character for n in range(6))
    assert "".join(named) == "fringe"


def test_without_a_star_only_the_target_is_marked():
    state = shown(FakeSupervisor("ACQUISITION"))
    characters = {
        mark.character
        for mark in cell_marks(tick_overlays(state.loop.tick), place(40, 40, 40, 20)).values()
    }
    assert characters == {"▔", "│"}


def test_a_fringe_spot_is_marked_on_its_light_and_named_in_the_caption():
    state = shown(FakeSupervisor())
    frame, placing = state.newest.frame, place(40, 40, 40, 20)
    marks = cell_marks(spot_overlays(state.loop), placing)
    column, row = next(cell for cell in marks if marks[cell].character == "◦")
    az_px, el_px = placing.pixel(column, row)
    image = np.frombuffer(frame.data, "<u2").reshape(40, 40).astype(int)
    near = image[round(el_px) - 1 : round(el_px) + 2, round(az_px) - 1 : round(az_px) + 2]
    assert near.sum() - 9 * np.median(image) > 0.5 * 11_000

    caption = plain(FocalPlane(state).draw(40, 21))[-1]
    assert "◦ fringe" in caption
    assert "star" in caption


def test_without_a_star_no_other_spot_is_marked():
    assert not spot_overlays(shown(FakeSupervisor("ACQUISITION")).loop)


def test_what_has_no_room_in_the_caption_is_the_light_and_not_a_spots_name():
    state = shown(FakeSupervisor())
    changed_tick(state, star_flux_dn=1_234_567.0)
    caption = plain(FocalPlane(state).draw(40, 21))[-1]
    assert "◦ fringe" in caption
    assert "DN" not in caption


@pytest.mark.parametrize("size", [(100, 9), (40, 8), (39, 4)])  # as at 200x60, 120x40 and 80x24
def test_the_siderostat_is_told_with_its_limits_and_warned_of_near_them(size):
    state = shown(FakeSupervisor())
    (row,) = (line for line in plain(Stages(state).draw(*size)) if "sider " in line)
    assert row.rstrip().endswith("of ±600″")
    assert "!" not in row
    changed_tick(state, siderostat_az_sky_arcsec=-590.0, siderostat_el_sky_arcsec=-123.4)
    (row,) = (line for line in plain(Stages(state).draw(*size)) if "sider " in line)
    assert "−590.0" in row
    assert "!" in row
    assert row.rstrip().endswith("of ±600″")
    assert len(row.rstrip()) <= size[0]


@pytest.mark.parametrize(
    ("travel_arcsec", "narrow", "wide"),
    [(1200.0, " ±1200″", "of ±1200″"), (12e5, " ″", "of ±1.2e+06″")],
)
def test_a_limit_without_room_is_told_shorter_or_left_out_but_never_cut(
    travel_arcsec, narrow, wide
):
    state = shown(FakeSupervisor())
    limits = state.loop.state.limits
    limits = msgspec.structs.replace(limits, siderostat_travel_sky_arcsec=travel_arcsec)
    state.loop.state = msgspec.structs.replace(state.loop.state, limits=limits)
    for columns, rows, ends in ((40, 8, narrow), (100, 9, wide)):
        lines = plain(Stages(state).draw(columns, rows))
        (row,) = (line.rstrip() for line in lines if "sider " in line)
        assert row.endswith(ends)


@pytest.mark.parametrize("size", [(39, 9), (79, 19)])  # as at 80x24 and 120x40
def test_the_traces_have_a_time_axis_and_name_the_requirement(size):
    lines = plain(Traces(shown(FakeSupervisor(), 450)).draw(*size))
    assert lines[-1].split() == ["−20", "s", "−10", "s", "now"]
    assert [line[:5].strip() for line in lines].count("+0.1") == 2
    assert [line[:5].strip() for line in lines].count("−0.1") == 2
    assert " mas" in lines[0]


def test_without_a_row_for_the_time_axis_its_span_is_in_the_headings():
    lines = plain(Traces(shown(FakeSupervisor(), 450)).draw(79, 8))
    assert " px · 20 s " in lines[0]
    assert "now" not in lines[-1]


def test_the_requirement_gives_way_to_the_sky_and_both_to_the_rms():
    traces = Traces(shown(FakeSupervisor(), 450))
    assert "of 0.1 px ✓ 83 mas" in plain(traces.draw(50, 9))[0]
    assert "of" not in plain(traces.draw(39, 9))[0]
    assert plain(traces.draw(31, 9))[0].endswith("✓")


def test_the_search_has_its_map_with_the_way_and_the_field():
    lines = plain(Traces(shown(FakeSupervisor("ACQUISITION"), 400)).draw(76, 20))
    told = "\n".join(lines)
    assert "searched 37 %" in told
    assert "field, 108″" in told
    assert "radius 215″" in told


def loop_of(errors_px, *, time_s=None, **columns):
    """A console's view of a loop in VERNIER, with errors, shape (ticks, 2)."""
    state = shown(FakeSupervisor(), 1)
    loop = state.loop
    loop.past = Past(TICK_FIELDS)
    loop.state = msgspec.structs.replace(loop.state, since_s=0.0)
    time_s = 100.0 + 0.02 * np.arange(len(errors_px)) if time_s is None else time_s
    ticks = dict.fromkeys(TICK_FIELDS, np.zeros(len(errors_px)))
    ticks |= {
        "time_s": time_s,
        "mid_exposure_s": time_s - 0.035,
        "star_flux_dn": 28000.0 + 0 * time_s,
    }
    ticks |= {"error_az_px": errors_px[:, 0], "error_el_px": errors_px[:, 1]} | columns
    loop.past.add(np.column_stack([ticks[name] for name in TICK_FIELDS]), time_s[-1])
    return state


def test_the_spectrum_has_a_line_where_the_error_has_one():
    times_s = np.arange(0, 20, 0.02)
    tone = np.sqrt(2) * 0.05 * np.sin(2 * np.pi * 4.0 * times_s)
    found = loop_spectra(loop_of(np.column_stack([tone, 0 * tone])).loop, 20.0, None)
    assert found.frequency_hz[np.argmax(found.error[:, 0])] == pytest.approx(4.0, abs=0.2)
    rms_px = np.sqrt(np.sum(found.error, axis=0) * found.frequency_hz[0])
    assert rms_px == pytest.approx([0.05, 0.0], abs=0.003)


def test_a_spectrum_needs_a_second_and_more_of_the_star():
    few = np.full((200, 2), math.nan)
    few[150:] = 0.01
    assert loop_spectra(loop_of(few).loop, 20.0, None) is None
    few[100:] = 0.01
    assert loop_spectra(loop_of(few).loop, 20.0, None) is not None


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [(3e-4, 0.04, (2e-4, 0.05)), (1e-3, 1e-1, (1e-3, 1e-1)), (0.3, 0.3, (0.2, 0.5))],
)
def test_the_spectrum_s_scale_is_that_of_its_data(low, high, wanted):
    assert _limits(np.array([low, high, 0.0])) == pytest.approx(wanted)


def test_a_cell_in_which_both_axes_lie_has_a_colour_of_its_own():
    noise = np.random.default_rng(1).normal(0.0, 0.02, (1000, 1))
    lines = Spectrum(loop_of(np.hstack([noise, noise])), "", DesignFigures()).draw(60, 16)
    inks = [segment.style.color.name for line in lines[1:-1] for segment in line[2:]]
    assert WHITE in inks
    assert AZ not in inks  # both axes are the same line here
    assert EL not in inks


def known_design(state, controller="eq20"):
    figures = DesignFigures()
    output = json.dumps({"stable": True, "theory": theory_to_plain(theory_of(controller))})
    figures.accept(design_in_use(state.loop.state), output, 0)
    return figures


def test_the_disturbance_and_the_prediction_are_drawn_where_the_theory_is_known():
    noise = np.random.default_rng(1).normal(0.0, 0.02, (1000, 2))
    state = loop_of(noise)
    assert plain(Spectrum(state, "", DesignFigures()).draw(60, 16))[0].split()[:3] == [
        "az",
        "el",
        "both",
    ]
    heading = plain(Spectrum(state, "", known_design(state)).draw(60, 16))[0].split()
    assert heading[:5] == ["az", "el", "design", "disturbance", "both"]


def test_the_error_budget_says_what_is_measured_what_was_expected_and_why():
    noise = np.random.default_rng(1).normal(0.0, 0.05, (2000, 2))
    state = loop_of(noise)
    verdict, bar_line, parts = plain(ErrorBudget(state, "", known_design(state)).draw(118, 3))
    assert verdict.startswith("▲ 0.050 px, expected 0.020: excess mostly ")
    assert verdict.endswith("over 40 s")
    assert len(bar_line) == 118
    assert sum(map(int, re.findall(r"-?\d+(?= %)", parts.replace("−", "-")))) == 100
    for columns in (118, 80):
        short = plain(ErrorBudget(state, "", known_design(state)).draw(columns, 2))
        assert len(short) == 2
        assert all(len(line) <= columns for line in short)


def test_the_error_budget_tells_which_part_of_the_stages_is_not_identified():
    state = loop_of(np.random.default_rng(1).normal(0.0, 0.02, (2000, 2)))
    figures = known_design(state)
    figures.theory = figures.theory._replace(hysteresis_known=False)
    assert "hysteresis not identified" in plain(ErrorBudget(state, "", figures).draw(118, 3))[0]


def test_the_error_budget_waits_for_ticks_and_for_the_designs_figures():
    state = loop_of(np.full((100, 2), math.nan))
    (line,) = plain(ErrorBudget(state, "", known_design(state)).draw(80, 3))
    assert "64 ticks with a star" in line
    assert len(line) <= 80
    assert (
        "needs the design's figures"
        in plain(ErrorBudget(state, "", DesignFigures()).draw(80, 3))[0]
    )


def test_a_design_file_that_was_edited_after_the_loop_loaded_it_has_no_figures():
    figures = DesignFigures()
    for digest, problem in (
        ("now", "steep.json has changed since the loop loaded it"),
        ("loaded", ""),
    ):
        output = json.dumps({"stable": True, "digest": digest})
        figures.accept(DesignInUse("right", "/designs/steep.json", None, "loaded"), output, 0)
        assert figures.problem == problem


def test_other_modes_have_neither_an_error_budget_nor_a_prediction():
    state = loop_of(np.random.default_rng(1).normal(0.0, 0.02, (2000, 2)))
    figures = known_design(state)
    state.loop.state = msgspec.structs.replace(state.loop.state, mode="COARSE")
    assert plain(ErrorBudget(state, "", figures).draw(80, 3)) == ["error budget: in VERNIER only"]
    assert "design" not in plain(Spectrum(state, "", figures).draw(60, 16))[0]


def test_margins_are_compared_with_what_is_usual():
    state, figures = shown(FakeSupervisor(), 400), DesignFigures()
    margins = Margins(state, "", figures, lambda _loop: "")
    at_work = DesignInUse("right", "minimum-variance")
    printed = {
        "stable": True,
        "crossover_hz": 3.9,
        "phase_margin_deg": 22.7,
        "gain_margin_db": 7.1,
        "peak_sensitivity": 2.001,  # shown as 2.00: the limit
        "attenuation_1hz": 6.1,
        "residual_px": 0.0131,
    }
    figures.accept(at_work, json.dumps(printed), 0)
    lines = plain(margins.draw(60, 12))
    assert next(line for line in lines if "phase" in line).endswith("▲")
    assert next(line for line in lines if "gain" in line).endswith("✓")
    assert next(line for line in lines if "sensitivity" in line).endswith("✓")
    assert any("0.0131 px, true star" in line for line in lines)
    figures.accept(at_work, "design: no such loop", 2)
    assert "✗ design: no such loop" in "\n".join(plain(margins.draw(60, 12)))


def test_the_tick_is_broken_down_into_parts_that_make_up_the_whole():
    state = shown(FakeSupervisor(), 400)
    lines = plain(Breakdown(state).draw(100, 8))
    median = {line.split()[0]: float(line.split()[1]) for line in lines[1:]}
    whole = median["sense"] + median["decide"] + median["write"]
    assert whole == pytest.approx(median["tick"], abs=0.02)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("compute_s", [0.0, math.nan])
def test_ticks_that_took_no_time_are_shown_without_shares(compute_s):
    state = shown(FakeSupervisor(), 50)
    tick = changed_tick(state, compute_s=compute_s, sense_s=compute_s, decide_s=compute_s)
    state.loop.past = Past(TICK_FIELDS)
    state.loop.past.add([[getattr(tick, field) for field in TICK_FIELDS]], tick.time_s)
    lines = plain(Breakdown(state).draw(100, 8))
    assert lines[-1].split()[:2] == (["tick", "0.00"] if compute_s == 0 else ["no", "ticks"])
