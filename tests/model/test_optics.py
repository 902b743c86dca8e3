import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.model.optics import (
    mirror_angles,
    mirror_from_stacks,
    mirror_normal,
    piston_m,
    saturate_diamond,
    scales,
    stack_volts,
)

RADIUS_M, SCALE_M_PER_V, BIAS_V, RANGE_RAD = 0.0225, 8.0e-7, 5.0, 1.772e-4
MIRROR = (RADIUS_M, SCALE_M_PER_V, BIAS_V)
angle_pairs = st.tuples(*2 * [st.floats(-1e-3, 1e-3)]).map(np.array)
displacements = st.tuples(*3 * [st.floats(-4e-6, 4e-6)]).map(np.array)


@pytest.fixture
def scale(rig):
    return scales(rig, rig.loops["right"])


# ---------------------------------------------------------------- Table 1


def test_one_encoder_count_turns_the_siderostat_mirror_by_12_7_mas(rig):
    siderostat = rig.loops["right"].siderostat
    count_rad = 2 * math.pi / siderostat.encoder_counts_per_rev
    # The beam turns by twice the mirror.
    mirror_rad = count_rad * siderostat.sky_rad_per_motor_rad / 2
    assert mirror_rad == pytest.approx(6.17e-8, rel=1e-3)
    assert mirror_rad * ARCSEC_PER_RAD * 1e3 == pytest.approx(12.7, abs=0.05)


def test_an_arcsecond_on_the_sky_is_0_369_px(scale):
    assert 1 / scale.sky_arcsec_per_px == pytest.approx(0.369, abs=5e-4)
    assert 0.25 / scale.sky_arcsec_per_px == pytest.approx(0.092, abs=5e-4)


def test_the_field_is_108_arcsec_on_the_sky(rig, scale):
    assert rig.camera.width_px * scale.sky_arcsec_per_px == pytest.approx(108, abs=0.5)


def test_a_radian_of_motor_is_0_1437_mm_on_the_focal_plane(rig, scale):
    assert scale.motor_px_per_rad * scale.pixel_size_m == pytest.approx(1.437e-4, rel=5e-4)
    assert scale.motor_px_per_rad == pytest.approx(
        rig.loops["right"].siderostat.sky_arcsec_per_motor_rad / scale.sky_arcsec_per_px
    )


def test_the_mirrors_full_range_is_6_75_px(rig, scale):
    range_rad = rig.loops["right"].fsm.range_rad
    assert range_rad * ARCSEC_PER_RAD == pytest.approx(36.5, abs=0.06)
    assert range_rad * scale.mirror_px_per_rad == pytest.approx(6.75, abs=5e-3)


def test_one_step_of_the_dac_turns_the_mirror_by_1_1_mas(rig, scale):
    dac = rig.loops["right"].fsm.dac
    step_v = dac.full_scale_v / 2**dac.bits
    turned_rad = mirror_angles(BIAS_V + step_v * np.array([1.0, 1.0, -1.0]), *MIRROR)
    assert step_v == pytest.approx(0.153e-3, abs=0.5e-6)
    assert turned_rad[0] * ARCSEC_PER_RAD * 1e3 == pytest.approx(1.1, abs=0.05)
    assert turned_rad[0] * scale.mirror_px_per_rad == pytest.approx(2.1e-4, abs=5e-6)


def test_the_backlash_is_0_37_px(rig, scale):
    backlash_arcsec = rig.plant.loops["right"].backlash_sky_arcsec
    assert backlash_arcsec / scale.sky_arcsec_per_px == pytest.approx(0.37, abs=5e-3)


# ---------------------------------------------------------------- stages that are turned


def turned_scale(siderostat_deg, mirror_deg):
    rig = load_rig(
        default_rig_path(),
        [
            f"loops.right.siderostat.rotation_deg={siderostat_deg}",
            f"loops.right.fsm.rotation_deg={mirror_deg}",
        ],
    )
    return scales(rig, rig.loops["right"])


def test_a_turned_stage_moves_the_star_along_its_own_axes():
    scale = turned_scale(30.0, -90.0)
    along_az = np.array([1.0, 0.0])
    assert scale.motor_px(along_az) / scale.motor_px_per_rad == pytest.approx(
        [math.sqrt(3) / 2, 0.5]
    )
    assert scale.mirror_px(along_az) / scale.mirror_px_per_rad == pytest.approx([0.0, -1.0])


@pytest.mark.long
@given(st.floats(-180, 180), st.floats(-180, 180), angle_pairs)
def test_what_moves_the_star_and_back_is_the_identity(siderostat_deg, mirror_deg, motor_rad):
    scale = turned_scale(siderostat_deg, mirror_deg)
    assert scale.motor_rad(scale.motor_px(motor_rad)) == pytest.approx(motor_rad, abs=1e-15)
    assert scale.sky_arcsec(scale.sky_px(motor_rad)) == pytest.approx(motor_rad, abs=1e-15)
    # An angle on the sky is what the motors would have to turn the beam by.
    motor_arcsec = scale.sky_arcsec(scale.motor_px(motor_rad))
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat
    assert motor_arcsec == pytest.approx(motor_rad * siderostat.sky_arcsec_per_motor_rad, abs=1e-12)


@pytest.mark.long
@given(angle_pairs)
def test_without_a_rotation_nothing_is_rounded(pair):
    scale = turned_scale(0.0, 0.0)
    assert np.array_equal(scale.motor_px(pair), scale.motor_px_per_rad * pair)
    assert np.array_equal(scale.mirror_px(pair), scale.mirror_px_per_rad * pair)
    assert np.array_equal(scale.motor_rad(pair), pair / scale.motor_px_per_rad)


# ---------------------------------------------------------------- the mirror on its stacks, Eq. 1-5


@given(angle_pairs)
def test_angles_to_volts_and_back_is_the_identity(mirror_rad):
    volts = stack_volts(mirror_rad, *MIRROR)
    assert mirror_angles(volts, *MIRROR) == pytest.approx(mirror_rad, abs=1e-15)


def test_a_mirror_at_rest_has_every_stack_at_its_bias():
    assert stack_volts(np.zeros(2), *MIRROR).tolist() == [BIAS_V] * 3


def test_a_batch_of_mirrors_is_each_mirror_alone():
    several_rad = np.linspace(-1e-4, 1e-4, 8).reshape(4, 2)
    batch = stack_volts(several_rad, *MIRROR)
    assert batch.shape == (4, 3)
    assert batch[2] == pytest.approx(stack_volts(several_rad[2], *MIRROR))
    assert mirror_angles(batch, *MIRROR) == pytest.approx(several_rad)


@given(displacements)
def test_the_mirrors_normal_agrees_with_the_plane_of_small_angles(displacement_m):
    az_rad, el_rad = mirror_from_stacks(displacement_m, RADIUS_M)
    normal = mirror_normal(displacement_m, RADIUS_M)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert normal[0] / normal[2] == pytest.approx(az_rad, abs=1e-15)
    assert -normal[1] / normal[2] == pytest.approx(el_rad, abs=1e-15)


@given(angle_pairs)
def test_ideal_stacks_give_no_piston(mirror_rad):
    displacement_m = (stack_volts(mirror_rad, *MIRROR) - BIAS_V) * SCALE_M_PER_V
    assert mirror_from_stacks(displacement_m, RADIUS_M) == pytest.approx(mirror_rad, abs=1e-15)
    assert piston_m(displacement_m, RADIUS_M) == pytest.approx(0.0, abs=1e-18)


@given(displacements, st.floats(-4e-6, 4e-6))
def test_moving_all_stacks_alike_is_piston_and_turns_nothing(displacement_m, piston):
    moved_m = displacement_m + piston
    turned = mirror_from_stacks(moved_m, RADIUS_M) - mirror_from_stacks(displacement_m, RADIUS_M)
    assert turned == pytest.approx(0.0, abs=1e-15)
    gained_m = piston_m(moved_m, RADIUS_M) - piston_m(displacement_m, RADIUS_M)
    assert gained_m == pytest.approx(piston, abs=1e-15)


# ---------------------------------------------------------------- what three stacks can reach


@given(angle_pairs)
def test_saturation_stays_inside_the_diamond_and_keeps_the_direction(mirror_rad):
    limited_rad = saturate_diamond(mirror_rad, RANGE_RAD)
    assert np.abs(limited_rad).sum() <= RANGE_RAD * (1 + 1e-12)
    across = limited_rad[0] * mirror_rad[1] - limited_rad[1] * mirror_rad[0]
    assert across == pytest.approx(0.0, abs=1e-18)
    assert np.all(limited_rad * mirror_rad >= 0)


@given(angle_pairs)
def test_saturation_leaves_what_is_in_reach_alone_and_uses_the_whole_range_otherwise(mirror_rad):
    limited_rad = saturate_diamond(mirror_rad, RANGE_RAD)
    reach_rad = np.abs(mirror_rad).sum()
    if reach_rad <= RANGE_RAD:
        assert limited_rad.tolist() == mirror_rad.tolist()
    else:
        assert np.abs(limited_rad).sum() == pytest.approx(RANGE_RAD)


@given(angle_pairs)
def test_a_saturated_mirror_never_overdrives_a_stack(mirror_rad):
    volts = stack_volts(saturate_diamond(mirror_rad, RANGE_RAD), *MIRROR)
    assert np.all((volts >= 0) & (volts <= 2 * BIAS_V))


def test_clipping_each_axis_by_itself_would_overdrive_a_stack():
    assert stack_volts(np.array([RANGE_RAD, RANGE_RAD]), *MIRROR).max() > 2 * BIAS_V
