import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import Hysteresis
from fitctl.model import hysteresis
from fitctl.model.hysteresis import (
    displacement_series,
    gains_from_slopes,
    half_widths_v,
    hysteresis_output,
    inverse_model,
    inverse_state,
    play,
    stack_gains,
)

HALF_WIDTH_V = np.array([0.0, 0.1, 0.25, 0.45, 0.7, 1.0, 1.4, 1.9, 2.5, 3.2, 4.0, 4.5, 4.9])
FULL_V = 10.0
volts = st.floats(-10, 10)
histories = st.lists(volts, max_size=20)


def states(voltages, start=None, half_width=HALF_WIDTH_V):
    """Plays' outputs after each voltage, from a relaxed stack or from `start`."""
    state = np.zeros_like(half_width) if start is None else start
    trail = []
    for voltage in voltages:
        state = play(state, np.asarray(voltage), half_width)
        trail.append(state)
    return np.array(trail)


def ramp(low_v, high_v, points=1001):
    return np.linspace(low_v, high_v, points)


@given(st.lists(st.tuples(volts, volts), max_size=60))
def test_a_series_at_once_is_play_by_play(history):
    series = np.array(history).reshape(-1, 2)
    gains = np.random.default_rng(2).random((2, len(HALF_WIDTH_V)))

    at_once = displacement_series(series, HALF_WIDTH_V, gains)

    assert at_once.shape == series.shape
    for n in range(2 if history else 0):
        assert at_once[:, n].tolist() == hysteresis_output(states(series[:, n]), gains[n]).tolist()


# ---------------------------------------------------------------- the play operator


@given(histories, volts)
def test_a_plays_output_is_never_more_than_half_its_width_from_the_input(history, last):
    final = states([*history, last])[-1]
    # Rounding: (v + r) - v is r only to the last bit.
    assert np.all(np.abs(final - last) <= HALF_WIDTH_V + 1e-14)


@given(histories, volts, volts, st.integers(2, 50))
def test_a_play_does_not_know_how_fast_it_was_driven(history, here, there, points):
    at_once = states([*history, here, there])[-1]
    slowly = states([*history, *ramp(here, there, points)])[-1]
    assert slowly == pytest.approx(at_once, abs=1e-12)


@given(histories, st.floats(0, 5))
def test_a_larger_swing_wipes_out_all_smaller_ones(history, further):
    largest = max(map(abs, history), default=0.0) + further
    assert states([*history, largest])[-1].tolist() == states([largest])[-1].tolist()


@given(st.floats(0, 10), st.floats(-1, 1), st.floats(-1, 1))
def test_a_minor_loop_closes_where_it_left(peak, part, inner):
    turn = part * peak
    trail = states([peak, turn, turn + abs(inner) * (peak - turn), turn, peak])
    assert trail[-1] == pytest.approx(trail[0], abs=1e-12)


def test_a_play_stands_still_inside_its_width():
    assert states([1.0, 0.9, 0.2, -0.9, 1.0], half_width=np.array([1.0])).tolist() == 5 * [[0.0]]


# ---------------------------------------------------------------- Eq. 6

slope_lists = st.lists(
    st.floats(1e-8, 2e-6), min_size=HALF_WIDTH_V.size, max_size=HALF_WIDTH_V.size
)


def measured_slopes(voltages, start, breakpoints_v, gains):
    """Slope between neighbouring breakpoints of the curve that a ramp traces."""
    edges_v = np.append(breakpoints_v, FULL_V)
    stroke = hysteresis_output(states(voltages, start), gains)
    return np.diff(np.interp(edges_v, voltages, stroke)) / np.diff(edges_v)


@given(slope_lists)
def test_gains_from_slopes_reproduce_a_virgin_ramp(slopes):
    gains = gains_from_slopes(np.array(slopes))
    voltages = np.union1d(ramp(0, FULL_V, 50), HALF_WIDTH_V)
    measured = measured_slopes(voltages, None, HALF_WIDTH_V, gains)
    assert measured == pytest.approx(np.array(slopes), rel=1e-9, abs=1e-15)


@given(slope_lists)
def test_a_swept_ramp_bends_at_twice_the_breakpoints(slopes):
    gains = gains_from_slopes(np.array(slopes))
    swept = states([FULL_V, 0.0])[-1]
    voltages = np.union1d(ramp(0, FULL_V, 50), 2 * HALF_WIDTH_V)
    measured = measured_slopes(voltages, swept, 2 * HALF_WIDTH_V, gains)
    assert measured == pytest.approx(np.array(slopes), rel=1e-9, abs=1e-15)


# ---------------------------------------------------------------- the rig's stack


@pytest.fixture
def stack(rig):
    """Breakpoints and gains of the default rig's stack."""
    settings = rig.plant.loops["right"].hysteresis
    return np.array(settings.breakpoints_v), stack_gains(settings, rig.loops["right"].fsm)


def closed_loop(stack, low_v, high_v):
    """Rising and falling branch, both on rising voltages, of a loop between two voltages."""
    half_width, gains = stack
    arrived = states([FULL_V, 0.0, high_v, low_v], half_width=half_width)[-1]
    up = states(ramp(low_v, high_v), arrived, half_width)
    down = states(ramp(high_v, low_v), up[-1], half_width)
    return hysteresis_output(up, gains), hysteresis_output(down, gains)[::-1]


def relative_width(branches):
    rising, falling = branches
    return (falling - rising)[rising.size // 2] / np.ptp(rising)


def test_the_stack_has_the_configured_stroke_and_loop_width(rig, stack):
    settings = rig.plant.loops["right"].hysteresis
    rising, falling = closed_loop(stack, 0.0, FULL_V)
    assert np.ptp(rising) == pytest.approx(settings.full_swing_stroke_m)
    assert (falling - rising).max() <= settings.loop_width_fraction * np.ptp(rising) * 1.001
    assert relative_width((rising, falling)) == pytest.approx(settings.loop_width_fraction)


@pytest.mark.parametrize("width", [0.0, 0.05, 0.2])
def test_other_loop_widths_come_out_as_asked(rig, width):
    settings = rig.plant.loops["right"].hysteresis.model_copy(update={"loop_width_fraction": width})
    gains = stack_gains(settings, rig.loops["right"].fsm)
    branches = closed_loop((np.array(settings.breakpoints_v), gains), 0.0, FULL_V)
    assert relative_width(branches) == pytest.approx(width, abs=1e-9)


def test_minor_loops_are_slimmer_than_the_full_one(stack):
    widths = [relative_width(closed_loop(stack, 5.0 - a, 5.0 + a)) for a in (0.2, 1.0, 2.0, 5.0)]
    assert widths == sorted(widths)
    assert widths[0] < 0.02


def test_near_the_bias_the_stack_moves_by_its_scale_within_2_db(rig, stack):
    rising, _ = closed_loop(stack, 4.8, 5.2)
    slope_m_per_v = np.ptp(rising) / 0.4
    assert abs(20 * np.log10(slope_m_per_v / rig.loops["right"].fsm.stack_scale_m_per_v)) < 2.0


def test_every_element_of_the_stack_adds_to_its_motion(stack):
    assert np.all(stack[1] > 0)


def test_the_closed_formulas_are_what_a_sweep_measures(stack):
    rising, falling = closed_loop(stack, 0.0, FULL_V)
    assert hysteresis.swept_stroke(*stack, FULL_V) == pytest.approx(np.ptp(rising))
    width_m = hysteresis.swept_loop_width(*stack, FULL_V)
    assert width_m == pytest.approx((falling - rising)[rising.size // 2])


def test_a_loop_wider_than_the_breakpoints_allow_is_refused(rig):
    narrow = Hysteresis(
        full_swing_stroke_m=9e-6,
        loop_width_fraction=0.5,
        breakpoints_from="virgin",
        breakpoints_v=[0.0, 0.1],
    )
    with pytest.raises(ValueError, match=r"loop_width_fraction 0\.5 is wider .* lower it"):
        stack_gains(narrow, rig.loops["right"].fsm)


def test_breakpoints_read_on_a_swept_ramp_are_twice_those_of_a_relaxed_stack(rig):
    settings = rig.plant.loops["right"].hysteresis
    doubled = [2 * v for v in settings.breakpoints_v]
    swept = settings.model_copy(update={"breakpoints_from": "swept", "breakpoints_v": doubled})

    assert np.array_equal(half_widths_v(swept), half_widths_v(settings))
    fsm = rig.loops["right"].fsm
    assert stack_gains(swept, fsm) == pytest.approx(stack_gains(settings, fsm))


# ---------------------------------------------------------------- the inverse

STACKS_GAINS = np.array([1.0, 0.7, 1.3])[:, None] * np.linspace(6e-7, 1e-8, HALF_WIDTH_V.size)
FALLING_GAINS = np.append(1e-6, np.full(HALF_WIDTH_V.size - 1, -5e-8))
wanted = st.lists(st.floats(-1e-5, 1e-5), min_size=3, max_size=3).map(np.array)
stack_histories = st.lists(
    st.lists(volts, min_size=3, max_size=3).map(lambda values: np.array(values)[:, None]),
    max_size=10,
)


def inverse_volts(plays_v, gains, wanted_m):
    """The voltages at which stacks reach a displacement."""
    half_width_m, gains_v_per_m = inverse_model(HALF_WIDTH_V, gains)
    plays_m = inverse_state(plays_v, gains, np.cumsum(gains, axis=-1))
    return hysteresis_output(play(plays_m, wanted_m[..., None], half_width_m), gains_v_per_m)


@given(stack_histories, wanted, st.sampled_from([STACKS_GAINS, np.tile(FALLING_GAINS, (3, 1))]))
def test_stacks_at_the_inverse_voltage_are_where_they_shall_be(history, wanted_m, gains):
    plays = np.zeros((3, HALF_WIDTH_V.size))
    for voltage in history:
        plays = play(plays, voltage, HALF_WIDTH_V)

    found_v = inverse_volts(plays, gains, wanted_m)

    reached_m = hysteresis_output(play(plays, found_v[:, None], HALF_WIDTH_V), gains)
    assert reached_m == pytest.approx(wanted_m, abs=1e-18)


@given(st.lists(wanted, max_size=10))
@pytest.mark.long
def test_the_inverse_is_a_model_of_plays_with_a_memory_of_its_own(wishes):
    half_width_m, gains_v_per_m = inverse_model(HALF_WIDTH_V, STACKS_GAINS)
    stacks = own = np.zeros((3, HALF_WIDTH_V.size))
    for wanted_m in wishes:
        found_v = inverse_volts(stacks, STACKS_GAINS, wanted_m)
        stacks = play(stacks, found_v[:, None], HALF_WIDTH_V)
        own = play(own, wanted_m[:, None], half_width_m)

        assert hysteresis_output(own, gains_v_per_m) == pytest.approx(found_v, abs=1e-9)
        slopes = np.cumsum(STACKS_GAINS, axis=-1)
        assert inverse_state(stacks, STACKS_GAINS, slopes) == pytest.approx(own, abs=1e-18)


def test_the_inverse_of_the_inverse_is_the_model():
    again = inverse_model(*inverse_model(HALF_WIDTH_V, STACKS_GAINS[0]))
    assert again[0] == pytest.approx(HALF_WIDTH_V)
    assert again[1] == pytest.approx(STACKS_GAINS[0])


def test_to_stay_costs_no_voltage():
    plays = states([3.0, 8.0, 4.2])[-1]
    here_m = hysteresis_output(plays, STACKS_GAINS[0])
    found_v = inverse_volts(plays, STACKS_GAINS[0], np.asarray(here_m))
    assert found_v == pytest.approx(4.2)
