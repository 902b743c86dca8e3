"""Fig. 7: the air path that frames show, beside the plant's."""

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.figures.air import coverage, figure_7

PHOTONS = "camera.electrons_per_dn=1.0"


def test_with_photon_noise_the_intervals_still_hold_the_plant_s_air_path():
    assert coverage(load_rig(default_rig_path(), [PHOTONS]), "right", 0, 1) > 0.5


@pytest.mark.long
@pytest.mark.parametrize("changed", [PHOTONS, "loops.right.sensor=fit"])
def test_the_noise_of_the_frames_is_that_of_the_loop_s_sensor(tmp_path, changed):
    plate = figure_7(load_rig(default_rig_path(), [changed]), "right", 0, tmp_path, 1)[0]
    noise = next(row for row in plate.rows if row.quantity.startswith("centroid noise"))
    assert noise.note.endswith("inside")
