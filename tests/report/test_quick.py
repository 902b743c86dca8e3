import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from samples.forged_logs import (
    forged_of,
    with_messages_of_another_program,
    with_topic_of_another_program,
)
from samples.log_samples import RUN_INFO, filled, frame, tick, write_log

from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info, tick_arrays
from fitctl.logging.records import MetrologyTick
from fitctl.messages.modes import Mode
from fitctl.report.quick import MOST_FIELDS, Series, as_figure, as_text, read_series


def labels(series):
    return [one.label for one in series]


@pytest.mark.long
@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        (["/fit/right/tick.error_az_px"], ["/fit/right/tick.error_az_px"]),
        (["error_*_px"], ["/fit/right/tick.error_az_px", "/fit/right/tick.error_el_px"]),
        (
            ["/fit/*/tick.stack2_v", "stack2_v"],
            [f"/fit/right/{topic}.stack2_v" for topic in ("tick", "opened", "piezo")],
        ),
        (
            ["/fit/right/piezo"],
            [f"/fit/right/piezo.{n}_v" for n in ("stack1", "stack2", "stack3", "limit")],
        ),
    ],
)
def test_fields_are_found_by_topic_by_pattern_or_by_name(held, wanted, found):
    assert labels(read_series(held[1], wanted)) == found


def test_the_values_are_those_of_the_log(held):
    (series,) = read_series(held[1], ["star_flux_dn"])
    ticks = tick_arrays(held[1], "right")

    np.testing.assert_array_equal(series.values, ticks["star_flux_dn"].astype(np.float32))
    np.testing.assert_allclose(np.diff(series.time_s), np.diff(ticks["time_s"]), atol=1e-6)


def test_a_span_of_time_is_all_that_is_read(held):
    start_ns = round(log_info(held[1]).start_s * 1e9)
    (series,) = read_series(held[1], ["star_flux_dn"], start_ns + 5 * 10**9, start_ns + 7 * 10**9)

    assert series.time_s[0] == pytest.approx(5.0, abs=0.03)
    assert series.time_s[-1] == pytest.approx(7.0, abs=0.03)


@pytest.mark.parametrize(
    ("wanted", "told"),
    [
        ("/fit/right/tick", f"fields are too many to look at, at most {MOST_FIELDS}; choose of"),
        ("/fit/right/tick.colour", "has no /fit/right/tick.colour; /fit/right/tick has number"),
        (
            "/fit/right/tick.error_a_px",
            "has no /fit/right/tick.error_a_px; did you mean error_az_px or",
        ),
        ("star_flux", "has no star_flux; did you mean star_flux_dn"),
        ("colour", "has no colour; fields have names such as error_az_px; topics: /fit/"),
        ("/fit/right/tik", "did you mean /fit/right/tick"),
        ("/fit/elsewhere", "topics: /fit/"),
    ],
)
def test_what_is_not_there_is_answered_with_what_is(held, wanted, told):
    with pytest.raises(LogError) as raised:
        read_series(held[1], [wanted])

    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_terminal_gets_a_panel_for_each_unit_within_its_width(held, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    monkeypatch.setenv("LINES", "30")
    series = read_series(held[1], ["error_*_px", "fsm_range_fraction"])

    text = as_text(held[1], series, colours=False)

    assert max(map(len, text.splitlines())) <= 90
    for word in ("error_az_px", "error_el_px", "fsm_range_fraction", "px", "fraction", "held.mcap"):
        assert word in text
    assert "\x1b" not in text
    assert "\x1b" in as_text(held[1], series, colours=True)


def test_a_mode_is_all_that_is_read(held):
    ticks = tick_arrays(held[1], "right")
    held_ticks = ticks["error_az_px"][ticks["mode_number"] == Mode.VERNIER]
    (series,) = read_series(held[1], ["error_az_px"], mode=Mode.VERNIER)

    there = series.values[~np.isnan(series.values)]
    np.testing.assert_array_equal(there, held_ticks.astype(np.float32))
    assert not np.isnan(series.values[[0, -1]]).any()
    assert len(there) < len(ticks["error_az_px"])


def test_a_topic_of_the_rig_is_read_while_any_loop_is_in_the_mode(held):
    whole, vernier = (
        read_series(held[1], ["/fit/right/piezo.stack1_v"], mode=mode)[0]
        for mode in (None, Mode.VERNIER)
    )
    assert 0 < len(vernier.values) < len(whole.values)


def test_a_metrology_loop_s_mode_is_its_own(tmp_path):
    modes = [Mode.LOCKED, Mode.VERNIER]  # the second is of no metrology loop
    beams = [
        filled(MetrologyTick, loop="metrology", time_s=100.0 + n, mode_number=mode)
        for n, mode in enumerate(modes)
    ]
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, *beams, tick(1, mode_number=Mode.LOCKED)])

    (series,) = read_series(path, ["beam_az_arcsec"], mode=Mode.LOCKED)

    assert len(series.values) == 1


@pytest.mark.parametrize("topic", ["/odom/tick", "/fit/odom/tick"])
def test_ticks_of_another_program_have_no_mode(tmp_path, topic):
    path = with_messages_of_another_program(tmp_path / "b.mcap", topic, Log(line=7))
    mode = Mode(tick(1).mode_number)

    (series,) = read_series(path, ["/fit/right/tick.star_az_px"], mode=mode)

    assert series.values == [tick(1).star_az_px]


def test_a_mode_that_never_was_leaves_nothing(held):
    (series,) = read_series(held[1], ["error_az_px"], mode=Mode.LOCKED)

    assert len(series.time_s) == len(series.values) == 0


def test_the_vertical_range_is_as_wanted(held):
    series = read_series(held[1], ["error_az_px"])

    (axes,) = as_figure(held[1], series, (-0.25, 0.125)).axes
    assert axes.get_ylim() == (-0.25, 0.125)
    text = as_text(held[1], series, (-0.25, 0.125), colours=False)
    assert "-0.25" in text
    assert "0.12" in text


def test_no_line_crosses_a_time_without_values(held):
    time_s = np.arange(100.0)
    values = np.where((time_s < 30) | (time_s >= 60), 1.0, np.nan).astype(np.float32)
    lines = as_text(held[1], [Series("/t", "x_px", time_s, values)], colours=False).splitlines()

    (drawn,) = (line for line in lines if len(set(line) & set("▀▄█▌▐")) > 0)
    inside = drawn[drawn.index("┤") + 1 : drawn.rindex("│")]
    assert inside[len(inside) * 2 // 5 : len(inside) // 2].strip() == ""


def test_no_legend_lies_on_the_data(held):
    series = read_series(held[1], ["error_*_px", "fsm_range_fraction"])
    figure = as_figure(held[1], series)
    figure.draw_without_rendering()

    for axes in figure.axes:
        assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1 - 1
    lines = as_text(held[1], series, colours=False).splitlines()
    assert "error_az_px, error_el_px" in lines[0]


def test_a_field_without_a_value_leaves_an_empty_panel(held):
    series = read_series(held[1], ["servo_late_worst_s", "star_az_px"])

    assert "star_az_px" in as_text(held[1], series, colours=False)
    assert len(as_figure(held[1], series).axes) == 2


def test_values_without_a_limit_are_left_out(held):
    values = np.array([0.0, 1.0, np.inf, -np.inf, 2.0], dtype=np.float32)
    text = as_text(held[1], [Series("/t", "x_px", np.arange(5.0), values)], colours=False)

    assert "x_px" in text


def test_names_of_a_foreign_log_are_nothing_that_a_terminal_obeys(held):
    values = np.arange(5.0, dtype=np.float32)
    series = [Series(f"/{name}", f"x\x1b[2J{name}", np.arange(5.0), values) for name in "ab"]
    text = as_text(held[1], series, colours=False)

    assert "\x1b" not in text
    assert "u001b[2J" in text


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.inf, -1e300, 1e35])
def test_values_that_no_plot_can_show_are_counted_and_left_out(tmp_path, value):
    records = [RUN_INFO, tick(1), tick(2)]
    path = forged_of(records, tmp_path / "a.mcap", "/fit/right/tick", error_az_px=value)

    odd, usual = read_series(path, ["error_az_px", "error_el_px"])

    assert (odd.beyond, usual.beyond) == (2, 0)
    assert np.isnan(odd.values).all()
    assert not np.isnan(usual.values).any()


def test_pictures_and_topics_of_other_programs_are_called_what_they_are(tmp_path):
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, tick(1), frame(1)])
    with pytest.raises(
        LogError, match=r"camera/frame is of pictures, .*`fitctl log export --format npz`"
    ):
        read_series(path, ["/fit/camera/frame"])

    odd = with_topic_of_another_program(tmp_path / "b.mcap")
    assert labels(read_series(odd, ["number"])) == ["/fit/right/tick.number"]
    with pytest.raises(LogError, match=r"b\.mcap: /odo is without numbers to plot"):
        read_series(odd, ["/odo"])
