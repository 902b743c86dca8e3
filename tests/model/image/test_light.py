import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from fitctl.model.image.light import REACH_SIGMAS, light_below


def test_the_table_is_the_normal_distribution_to_4e_9():
    distance = np.linspace(-REACH_SIGMAS, REACH_SIGMAS, 100_003)
    assert np.abs(light_below(distance) - ndtr(distance)).max() < 4e-9


@given(st.floats(-1e6, 1e6), st.floats(0, 1e3))
def test_more_light_is_below_a_higher_edge(edge, further):
    low, high = light_below(np.array([edge, edge + further]))
    assert 0.0 <= low <= high <= 1.0


def test_beyond_its_reach_a_spot_has_no_light():
    assert light_below(np.array([-9.0, 9.0])).tolist() == [light_below(np.array(-8.5)), 1.0]
