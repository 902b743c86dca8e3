"""What is drawn of numbers: the focal plane's marks, traces, the diamond, the search, spectrum and margins."""

import json
import math

import msgspec
import numpy as np
import pytest
import scipy.signal

from fitctl.tui.draw.frame import place
from fitctl.tui.draw.overlays import cell_marks, tick_overlays
from fitctl.tui.widgets.focalplane import FocalPlane, spot_overlays
from fitctl.tui.widgets.margins import DesignInUse, Margins
from fitctl.tui.widgets.spectrum import spectra_of
from fitctl.tui.widgets.stages import Stages, working_point
from fitctl.tui.widgets.timing import Breakdown
from fitctl.tui.widgets.traces import Traces, axis_limit_px, trace_lines
from tests.fake_supervisor import FakeSupervisor
from tests.tui.drawn import changed_tick, plain, shown


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
    marks = cell_marks(tick_overlays(tick), place(40, 40, 40, 20))
    assert marks[10, 4].character == "+"
    assert (marks[6, 2].character, marks[14, 2].character) == ("┌", "┐")


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
    ((column, row),) = cell_marks(spot_overlays(state.loop), placing)
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
    margins = Margins(shown(FakeSupervisor(), 400), "", lambda _loop: "")
    at_work = DesignInUse("right", "minimum-variance")
    told = {
        "stable": True,
        "crossover_hz": 3.9,
        "phase_margin_deg": 22.7,
        "gain_margin_db": 7.1,
        "peak_sensitivity": 1.9,
        "attenuation_1hz": 6.1,
        "residual_px": 0.0131,
    }
    margins.show_result(at_work, json.dumps(told), 0)
    lines = plain(margins.draw(60, 12))
    assert next(line for line in lines if "phase" in line).endswith("▲")
    assert next(line for line in lines if "gain" in line).endswith("✓")
    assert any("0.0131 px, by linear theory" in line for line in lines)
    margins.show_result(at_work, "design: no such loop", 2)
    assert "✗ design: no such loop" in "\n".join(plain(margins.draw(60, 12)))


def test_the_tick_is_broken_down_into_parts_that_make_up_the_whole():
    state = shown(FakeSupervisor(), 400)
    lines = plain(Breakdown(state).draw(100, 8))
    median = {line.split()[0]: float(line.split()[1]) for line in lines[1:]}
    whole = median["sense"] + median["decide"] + median["write"]
    assert whole == pytest.approx(median["tick"], abs=0.02)
