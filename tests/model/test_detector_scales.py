import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import ARCSEC_PER_RAD
from fitctl.model.detector import DETECTOR_RANGE_V, detector_volts, mirror_angles_seen


def test_the_papers_chirp_of_7_arcsec_gives_under_two_volts():
    assert detector_volts(np.array(7.2 / ARCSEC_PER_RAD)) == pytest.approx(1.864, abs=0.001)


def test_the_detector_reaches_as_far_as_the_mirror_does_statically():
    assert detector_volts(np.array(1.772e-4)) < DETECTOR_RANGE_V


@given(st.floats(-2e-4, 2e-4), st.floats(-2e-4, 2e-4))
def test_angles_come_back(az_rad, el_rad):
    mirror_rad = np.array([az_rad, el_rad])
    assert mirror_angles_seen(detector_volts(mirror_rad)) == pytest.approx(mirror_rad)
