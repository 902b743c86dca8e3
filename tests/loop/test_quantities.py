"""What a loop's interlocks evaluate."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import Frame
from fitctl.loop.observation import Observation
from fitctl.loop.quantities import StellarQuantities


def observation(number, exposed_s, skipped):
    frame = Frame(number, exposed_s, exposed_s + 0.035, np.zeros((40, 40), np.uint16))
    return Observation(frame, 0, skipped, None, np.zeros(2), np.zeros(2), None, exposed_s + 0.036)


def test_a_camera_that_was_opened_anew_for_another_loop_gives_no_interval():
    quantities = StellarQuantities(load_rig(default_rig_path()), "right")
    quantities.record_observation(observation(1, 1.0, skipped=0))
    quantities.record_observation(observation(4, 1.06, skipped=2))
    interval = quantities.readings["frame_interval_periods"]
    assert interval[0] == pytest.approx(1.0)

    for skipped in (1, 0):  # it counts from zero again
        quantities.record_observation(observation(1, 9.0, skipped))
        assert quantities.readings["frame_interval_periods"] == interval


def test_only_a_fault_has_words(vernier):
    vernier.run(2.0)
    readings = vernier.supervisor.loops["right"].quantities.readings
    assert "siderostat_travel_fraction" in readings
    assert {name: words for name, (_, _, words) in readings.items() if words} == {}
