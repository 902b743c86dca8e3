"""The collector's geometry against rays that are traced through turned mirrors, without small angles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fitctl.config import CollectorGeometry, default_rig_path, load_rig
from fitctl.model.metrology.geometry import (
    array_from_pose,
    array_lever,
    fold,
    reflection,
    star_from_pose,
    star_turn,
    transverse_axes,
)

RIG = load_rig(default_rig_path().parent / "fit-testbed.toml").collector.geometry
TURN_RAD = 1e-5  # small angles are right to its square


def direction(angles):
    longitude, height = angles
    side = np.sqrt(1 - height**2)
    return np.array([side * np.cos(longitude), side * np.sin(longitude), height])


directions = st.tuples(st.floats(0, 2 * np.pi), st.floats(-1, 1)).map(direction)


@st.composite
def geometries(draw):
    """Light paths of all kinds; both mirrors really turn the light."""
    starlight, link, between = draw(directions), draw(directions), draw(directions)
    if max(starlight @ between, link @ between) > 0.9:
        between = -between
    if max(starlight @ between, link @ between) > 0.9:
        return RIG
    azimuth = np.cross(link, [0.0, 0.0, 1.0] if abs(link[2]) < 0.9 else [1.0, 0.0, 0.0])
    azimuth = azimuth / np.linalg.norm(azimuth)
    siderostat = np.array([0.1, -0.2, 0.15])
    return CollectorGeometry(
        starlight=starlight.tolist(),
        link=link.tolist(),
        link_azimuth=azimuth.tolist(),
        siderostat_m=siderostat.tolist(),
        array_m=(siderostat + 0.4 * between).tolist(),
        pivot_m=[0.02, 0.03, -0.05],
    )


def mirrors(geometry):
    """The normals of collector siderostat and transfer mirror."""
    between = np.subtract(geometry.array_m, geometry.siderostat_m)
    between = between / np.linalg.norm(between)
    return between - np.array(geometry.starlight), np.array(geometry.link) - between


def traced(geometry, turn):
    """The starlight after both mirrors of a bench that is turned, a scipy Rotation."""
    light = np.array(geometry.starlight)
    for normal in mirrors(geometry):
        unit = turn.apply(normal / np.linalg.norm(normal))
        light = light - 2 * (light @ unit) * unit
    return light


@given(geometry=geometries())
def test_both_mirrors_send_the_starlight_along_the_link(geometry):
    assert traced(geometry, Rotation.identity()) == pytest.approx(np.array(geometry.link))
    turns_light = fold(geometry)
    assert turns_light @ np.array(geometry.starlight) == pytest.approx(np.array(geometry.link))
    assert np.linalg.det(turns_light) == pytest.approx(1.0), "two reflections are a rotation"


@pytest.mark.long
@given(geometry=geometries(), axis=directions)
def test_c_is_what_rays_through_turned_mirrors_do(geometry, axis):
    psi = TURN_RAD * axis
    moved = traced(geometry, Rotation.from_rotvec(psi)) - np.array(geometry.link)
    assert star_turn(geometry) @ psi == pytest.approx(
        transverse_axes(geometry) @ moved, abs=10 * TURN_RAD**2
    )


@given(geometry=geometries(), angle_rad=st.floats(-0.5, 0.5))
def test_a_turn_about_the_folds_axis_leaves_the_starlight_however_large(geometry, angle_rad):
    first, second = mirrors(geometry)
    axis = np.cross(first, second)
    if np.linalg.norm(axis) < 1e-3:  # parallel mirrors leave it for every turn
        return
    axis = axis / np.linalg.norm(axis)
    turned = traced(geometry, Rotation.from_rotvec(angle_rad * axis))
    assert turned == pytest.approx(np.array(geometry.link), abs=1e-9)
    assert star_turn(geometry) @ axis == pytest.approx([0.0, 0.0], abs=1e-9)


@given(geometry=geometries())
def test_the_starlight_turns_by_twice_the_bench_at_the_most(geometry):
    assert np.linalg.norm(star_turn(geometry), 2) <= 2 + 1e-9


def test_two_parallel_mirrors_are_no_matter():
    periscope = CollectorGeometry(
        starlight=[1.0, 0.0, 0.0],
        link=[1.0, 0.0, 0.0],
        link_azimuth=[0.0, 1.0, 0.0],
        siderostat_m=[0.0, 0.0, 0.0],
        array_m=[0.0, 0.0, 0.5],
        pivot_m=[0.0, 0.0, 0.0],
    )
    assert star_turn(periscope) == pytest.approx(np.zeros((2, 3)), abs=1e-15)


@given(axis=directions)
def test_a_rotation_moves_the_array_by_its_lever(axis):
    psi = TURN_RAD * axis
    arm_m = np.subtract(RIG.array_m, RIG.pivot_m)
    moved_m = Rotation.from_rotvec(psi).apply(arm_m) - arm_m
    assert array_lever(RIG) @ psi == pytest.approx(
        transverse_axes(RIG) @ moved_m, abs=10 * TURN_RAD**2
    )


def test_a_pose_is_in_millimetres_and_degrees():
    assert array_from_pose(RIG) @ [5.0, 2.0, 3.0, 0, 0, 0] == pytest.approx([2e-3, 3e-3])
    assert star_from_pose(RIG) @ [5.0, 2.0, 3.0, 0, 0, 0] == pytest.approx([0.0, 0.0])
    one_deg = np.radians(1.0) * star_turn(RIG)[:, 2]
    assert star_from_pose(RIG) @ [0, 0, 0, 0, 0, 1.0] == pytest.approx(one_deg)


@pytest.mark.parametrize("axis", [0, 1])
def test_bench_and_combiner_siderostat_turn_the_star_by_one_sign(axis):
    """A trace to the end: laser out and starlight in by the left combiner siderostat's one mirror.

    Where its turn moves the laser on the array by +, it turns the starlight that it sends on as c psi does
    where that is +: so y_L has beta_L + c psi.
    """
    link, axes = np.array(RIG.link), transverse_axes(RIG)
    into_bench = np.array([0.0, 1.0, 0.0])  # from the siderostat on, the starlight's way
    normal = into_bench - link
    mount_rad = TURN_RAD * (axes[axis] - (axes[axis] @ normal) / (normal @ normal) * normal)
    mount_rad = np.cross(normal / np.linalg.norm(normal), mount_rad)
    turned_normal = Rotation.from_rotvec(mount_rad).apply(normal)
    laser = reflection(turned_normal) @ -into_bench
    on_array = axes @ (laser + link)
    by_siderostat = reflection(turned_normal) @ link - into_bench
    # The turn of the bench that would turn the incoming starlight as far along both axes.
    psi = np.linalg.pinv(star_turn(RIG)) @ on_array
    by_bench = reflection(normal) @ traced(RIG, Rotation.from_rotvec(psi)) - into_bench
    assert np.linalg.norm(on_array) > 0.5 * TURN_RAD
    assert by_bench == pytest.approx(by_siderostat, abs=20 * TURN_RAD**2)
