import numpy as np
import pytest

from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info, tick_arrays
from fitctl.report.quick import MOST_FIELDS, as_figure, as_text, read_series


def labels(series):
    return [one.label for one in series]


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
        ("colour", "has no colour; its topics are /fit/"),
        ("/fit/left/tick", "its topics are /fit/"),
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


def test_a_field_without_a_value_leaves_an_empty_panel(held):
    series = read_series(held[1], ["servo_late_worst_s", "star_az_px"])

    assert "star_az_px" in as_text(held[1], series, colours=False)
    assert len(as_figure(held[1], series).axes) == 2
