import dataclasses

import numpy as np
import pytest
from plant_records import record_of

from fitctl.config import default_rig_path, load_rig, rig_from_document
from fitctl.identify import backlash
from fitctl.identify.errors import IdentifyError
from fitctl.model.drives import experiment_s
from fitctl.model.optics import scales

pytestmark = pytest.mark.long


@pytest.fixture(scope="session")
def record(rig):
    return record_of(rig, "right", backlash.plan(rig, "right"), seed=1)


@pytest.fixture(scope="session")
def result(rig, record):
    return backlash.analyse(rig, record)


def with_backlash(rig, sky_arcsec):
    document = rig.model_dump()
    document["plant"]["loops"]["right"]["backlash_sky_arcsec"] = sky_arcsec
    return rig_from_document(document, "test")


def test_the_width_comes_out_within_five_percent(result):
    assert result.width_sky_arcsec == pytest.approx(1.0, rel=0.05)
    assert result.width_px == pytest.approx(0.369, rel=0.05)
    assert result.width_sd_px < 0.02 * result.width_px


@pytest.mark.parametrize("changed", ["camera.electrons_per_dn=1.0", "loops.right.sensor=fit"])
def test_with_another_noise_of_the_star_it_is_as_good(changed):
    other = load_rig(default_rig_path(), [changed])
    found = backlash.analyse(
        other, record_of(other, "right", backlash.plan(other, "right"), seed=1)
    )
    assert found.width_sky_arcsec == pytest.approx(1.0, rel=0.05)
    assert all(axis.excess < 1.2 for axis in found.axes.values())


def test_both_axes_tell_width_plate_scale_and_their_uncertainty(rig, result):
    nominal = scales(rig, rig.loops["right"]).motor_px_per_rad
    for axis in result.axes.values():
        assert abs(axis.width_px - 0.3693) < 3 * axis.width_sd_px
        assert abs(axis.px_per_motor_rad - nominal) < 3 * axis.px_per_motor_rad_sd
        assert axis.px_per_motor_rad_sd < 0.01 * nominal


@pytest.mark.parametrize("sky_arcsec", [0.5, 2.0])
def test_other_widths_are_found_as_well(rig, sky_arcsec):
    other = with_backlash(rig, sky_arcsec)
    record = record_of(other, "right", backlash.plan(other, "right"), seed=2)
    found = backlash.analyse(other, record)
    assert found.width_sky_arcsec == pytest.approx(sky_arcsec, rel=0.05)


def test_a_gear_train_without_play_has_a_width_of_about_zero(rig):
    tight = with_backlash(rig, 0.0)
    found = backlash.analyse(tight, record_of(tight, "right", backlash.plan(tight, "right")))
    assert found.width_px < 3 * found.width_sd_px


def test_a_gear_ratio_that_the_rig_file_has_wrong_is_seen(rig, record):
    document = rig.model_dump()
    siderostat = document["loops"]["right"]["siderostat"]
    siderostat["spur_gear_ratio"] *= 1.1
    siderostat["device"]["position_limit_rad"] *= 1.1
    found = backlash.analyse(rig_from_document(document, "test"), record)
    for axis in found.axes.values():
        assert axis.px_per_motor_rad / found.nominal_px_per_rad == pytest.approx(1.1, rel=0.01)
    assert found.width_px == pytest.approx(0.369, rel=0.05)


def test_wrong_time_stamps_are_not_taken_for_backlash(rig, record):
    shifted_s = record.tick["mid_exposure_s"] + 0.003
    tick = dict(record.tick)
    for name in ("siderostat_az_rad", "siderostat_el_rad"):
        tick[name] = np.interp(shifted_s, record.tick["mid_exposure_s"], record.tick[name])
    found = backlash.analyse(rig, dataclasses.replace(record, tick=tick))
    assert found.width_px == pytest.approx(0.369, rel=0.05)
    assert found.axes["az"].late_s == pytest.approx(-0.003, abs=0.0015)


def test_the_scan_is_short_and_keeps_the_star_in_the_middle(rig, record):
    assert experiment_s(backlash.plan(rig, "right")) < 60
    assert np.all(np.abs(record.star_px - [24.0, 19.5]) < 4.0)


def test_a_target_at_the_frames_edge_is_refused(rig):
    document = rig.model_dump()
    document["loops"]["right"]["target_px"] = {"az": 24.0, "el": 5.0}
    with pytest.raises(IdentifyError, match="must stay on the frame"):
        backlash.plan(rig_from_document(document, "test"), "right")


def test_a_record_without_motion_is_refused(rig):
    still = record_of(rig, "right", [], extra_s=20.0)
    with pytest.raises(IdentifyError, match=r"moved by 0\.00 px in az, expected at least 1 px"):
        backlash.analyse(rig, still)


def test_a_record_with_the_star_lost_is_refused(rig, record):
    tick = dict(record.tick)
    for name in ("star_az_px", "star_el_px"):  # one without the other there never is
        tick[name] = tick[name].copy()
        tick[name][1500:2000] = np.nan
    with pytest.raises(IdentifyError, match=r"the star is on \d+ of \d+ frames of az"):
        backlash.analyse(rig, dataclasses.replace(record, tick=tick))


def test_the_fragment_is_what_the_rig_file_knows(rig, result):
    section = result.fragment()["loops"]["right"]["siderostat"]
    document = rig.model_dump()
    document["loops"]["right"]["siderostat"].update(section)
    known = rig_from_document(document, "test").loops["right"].siderostat
    assert known.backlash_sky_arcsec == result.width_sky_arcsec


def test_an_operator_reads_pixels_arcseconds_and_plate_scale(result):
    *axes, last = result.lines()
    assert axes[0].startswith("az: 0.3")
    assert "px a motor radian" in axes[0]
    assert last.startswith("backlash 0.3")
    assert "arcsec on the sky" in last


def test_a_plot_is_drawn(result, tmp_path):
    result.draw().savefig(tmp_path / "loop.svg")
    assert (tmp_path / "loop.svg").stat().st_size > 10_000
