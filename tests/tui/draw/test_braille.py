import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fitctl.tui.draw import braille


def text_of(dots):
    return ["".join(map(chr, row)) for row in braille.cells(dots).tolist()]


def trace(times_s, values, *, width=10, rows=1, now_s=1.0, span_s=1.0, limit=1.0):
    dots = braille.empty(rows, width)
    braille.envelope(
        dots, np.array(times_s), np.array(values), now_s=now_s, span_s=span_s, limit=limit
    )
    return dots


def test_a_single_dot_is_the_right_character():
    dots = braille.empty(1, 1)
    dots[0, 0] = True
    assert text_of(dots) == ["⠁"]
    dots[3, 1] = True
    assert text_of(dots) == ["⢁"]


def test_all_dots_are_a_full_cell():
    assert text_of(~braille.empty(1, 2)) == ["⣿⣿"]


def test_the_newest_value_is_at_the_right_edge_and_up_is_positive():
    dots = trace([1.0], [1.0])
    assert dots[0, -1]
    assert dots.sum() == 1


def test_a_peak_among_many_samples_of_a_column_is_drawn():
    times_s = np.linspace(0, 0.99, 1000)
    values = np.zeros(1000)
    values[500] = 0.9
    dots = trace(times_s, values, now_s=0.99, rows=4)
    assert dots[:3].any()


def test_a_step_is_drawn_without_a_hole():
    dots = trace([0.91, 0.96], [1.0, -1.0], rows=2)
    assert dots[:, -2:].any(axis=1).all()


def test_what_is_not_a_number_leaves_a_gap():
    assert not trace([0.5, 0.6], [np.nan, np.nan]).any()


def test_what_is_older_than_the_span_is_not_drawn():
    assert not trace([-0.5], [0.0]).any()


def test_a_value_beyond_the_limit_is_drawn_on_the_edge():
    dots = trace([1.0], [50.0], rows=2)
    assert dots[0, -1]


@given(
    values=st.lists(st.floats(-5, 5) | st.just(float("nan")), max_size=200),
    rows=st.integers(1, 12),
    width=st.integers(1, 80),
)
def test_every_column_with_a_value_has_a_dot_and_no_other(values, rows, width):
    times_s = np.linspace(0.001, 0.999, len(values))
    dots = trace(times_s, values, rows=rows, width=width)
    bins = np.floor(times_s * 2 * width).astype(int) - 1
    expected = {b for b, value in zip(bins, values, strict=True) if b >= 0 and np.isfinite(value)}
    assert set(np.flatnonzero(dots.any(axis=0))) == expected


def test_the_diamond_touches_all_four_edges_and_only_in_its_corners():
    dots = braille.diamond(5, 11)
    assert dots[0].any()
    assert dots[-1].any()
    assert dots[:, 0].any()
    assert dots[:, -1].any()
    assert not dots[0, 0]
    assert not dots[10, 11]


def test_a_guide_outside_the_scale_is_not_drawn():
    dots = braille.empty(2, 4)
    braille.guide(dots, 2.0, 1.0, 1)
    assert not dots.any()
    braille.guide(dots, 1.0, 1.0, 2)
    assert dots[0].sum() == 4
