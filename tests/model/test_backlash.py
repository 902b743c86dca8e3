import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.model.backlash import describing_function
from fitctl.model.hysteresis import play


def fundamental(amplitude, half_width):
    """Of a play that a sine has driven for a period already, over the sine."""
    phase = np.linspace(0, 4 * np.pi, 8001)
    output, outputs = 0.0, []
    for value in amplitude * np.sin(phase):
        output = float(play(np.asarray(output), np.asarray(value), np.asarray(half_width)))
        outputs.append(output)
    return 2j * np.mean(outputs[4001:] * np.exp(-1j * phase[4001:])) / amplitude


@pytest.mark.parametrize("amplitude", [0.51, 0.7, 1.0, 3.0, 50.0])
def test_it_is_the_fundamental_of_a_play_driven_by_a_sine(amplitude):
    expected = fundamental(amplitude, 0.5)
    assert describing_function(amplitude, 0.5) == pytest.approx(expected, abs=2e-3)


@given(st.floats(0, 10), st.floats(0, 10))
def test_a_play_lags_and_never_amplifies(amplitude, half_width):
    value = describing_function(amplitude, half_width)
    assert abs(value) <= 1 + 1e-12
    assert value.imag <= 0
    assert value == 0 or amplitude > half_width


def test_no_play_is_no_change():
    assert describing_function([0.1, 1.0], 0.0) == pytest.approx([1.0, 1.0])


def test_arrays_of_amplitudes_and_widths_broadcast():
    values = describing_function(np.linspace(0, 2, 5)[:, None], [0.1, 0.3, 0.5])
    assert values.shape == (5, 3)
    assert values[3, 1] == describing_function(1.5, 0.3)
