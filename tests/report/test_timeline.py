"""Plots of the whole run, also of a log that no fitctl of today wrote."""

import dataclasses
import math

import numpy as np
import pytest

from fitctl.messages.modes import Mode
from fitctl.report.drawing import styled, time_axis
from fitctl.report.tables import UNKNOWN, seconds
from fitctl.report.timeline import running_rms, timeline


def with_ticks(loop, **changes):
    return dataclasses.replace(loop, ticks=loop.ticks | changes)


def test_a_mode_of_another_version_is_shown_as_not_known(findings):
    loop = findings.loops["right"]
    numbers = loop.ticks["mode_number"].copy()
    numbers[:50] = 42

    with styled():
        figure = timeline(findings, with_ticks(loop, mode_number=numbers), time_axis(60, "")).figure

    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert f"mode {UNKNOWN}" in labels
    assert Mode.VERNIER.name in labels


def test_a_loop_that_changes_its_mode_at_every_tick_is_drawn_in_few_pieces(findings):
    loop = findings.loops["right"]
    numbers = np.resize([Mode.VERNIER, Mode.COARSE], len(loop.ticks["mode_number"]))

    with styled():
        figure = timeline(findings, with_ticks(loop, mode_number=numbers), time_axis(60, "")).figure

    assert len(figure.axes[0].get_children()) < 50


@pytest.mark.parametrize(
    ("length_s", "shown"),
    [
        (math.inf, "inf s"),
        (-math.inf, "-inf s"),
        (math.nan, UNKNOWN),
        (119.0, "119.0 s"),
        (3700.0, "1 h 01 min"),
    ],
)
def test_a_length_of_time_is_shown_also_if_it_is_not_finite(length_s, shown):
    assert seconds(length_s) == shown


def four_ticks(findings, *times_s):
    """A loop that was held on four ticks, with errors of 3 and 4 px on each axis in turn."""
    loop = findings.loops["right"]
    ticks = {name: column[:4].copy() for name, column in loop.ticks.items()}
    ticks |= {
        "time_s": np.array(times_s),
        "mode_number": np.full(4, Mode.VERNIER),
        "error_az_px": np.array([3.0, 4.0, 3.0, 4.0], dtype=np.float32),
        "error_el_px": np.array([1.0, 1.0, 2.0, 2.0], dtype=np.float32),
    }
    return dataclasses.replace(loop, ticks=ticks)


def test_windows_that_do_not_follow_each_other_are_parted_by_one_gap(findings):
    at_s, rms = running_rms(four_ticks(findings, 1.0, 5.0, 12.0, 57.0))

    np.testing.assert_allclose(at_s, [3.0, 12.0, np.nan, 57.0])
    np.testing.assert_allclose(rms["az"], [math.sqrt(12.5), 3.0, np.nan, 4.0])
    np.testing.assert_allclose(rms["el"], [1.0, 2.0, np.nan, 2.0])


def test_a_log_of_ticks_centuries_apart_is_no_array_of_centuries(findings):
    at_s, rms = running_rms(four_ticks(findings, 1.0, 2.0, 3.0, 9e9))

    np.testing.assert_allclose(at_s, [2.0, np.nan, 9e9])
    assert [len(values) for values in rms.values()] == [3, 3]
