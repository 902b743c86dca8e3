"""A measured dark frame: hot pixels and uneven background no longer move the centroid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import ConfigError, HotPixel
from fitctl.controllers.centroid import StarSensor
from fitctl.controllers.dark import Dark, read_dark
from fitctl.model.image.scene import Scene

STAR = (24.3, 19.6)
HOT = HotPixel(az_px=22, el_px=20, dn=3000.0)


def with_dark(camera, tmp_path, dark_dn):
    path = tmp_path / "dark.npy"
    np.save(path, dark_dn)
    return camera.model_copy(update={"dark_file": str(path)})


@pytest.fixture
def level(rig):
    return np.full((rig.camera.height_px, rig.camera.width_px), rig.camera.bias_dn)


def measured(rig, camera, image):
    star = StarSensor(camera, rig.loops["right"]).measure(image, *STAR)
    return np.array([star.az_px, star.el_px])


def frame(rig, *hot):
    return Scene(rig.camera, rig.plant.loops["right"].spots[:1], hot).frame(np.array([STAR]), 5, 1)


def test_a_hot_pixel_that_is_subtracted_does_not_move_the_centroid(rig, tmp_path, level):
    level[HOT.el_px, HOT.az_px] += HOT.dn
    camera = with_dark(rig.camera, tmp_path, level)
    clean = measured(rig, rig.camera, frame(rig))

    assert np.linalg.norm(measured(rig, rig.camera, frame(rig, HOT)) - clean) > 0.15
    assert measured(rig, camera, frame(rig, HOT)) == pytest.approx(clean, abs=1e-9)


@pytest.mark.parametrize(("az", "el"), [(22, 20), (24, 20), (21, 17), (25, 19)])
def test_a_bad_pixel_is_filled_in_from_its_neighbours(rig, tmp_path, level, az, el):
    level[el, az] = np.nan
    camera = with_dark(rig.camera, tmp_path, level)
    stuck = HotPixel(az_px=az, el_px=el, dn=64_000.0)
    clean = measured(rig, rig.camera, frame(rig))

    assert np.linalg.norm(measured(rig, camera, frame(rig, stuck)) - clean) < 0.08


def test_a_step_of_background_in_the_window_is_taken_off(rig, tmp_path, level):
    level[:, 24:] += 60.0
    image = (frame(rig) + (level - rig.camera.bias_dn)).astype(np.uint16)
    clean = measured(rig, rig.camera, frame(rig))

    assert measured(rig, rig.camera, image)[0] - clean[0] > 0.05
    camera = with_dark(rig.camera, tmp_path, level)
    assert measured(rig, camera, image) == pytest.approx(clean, abs=1e-9)


def test_the_search_takes_no_hot_pixel_for_a_star_and_finds_the_star_beside_it(
    rig, tmp_path, level
):
    hot = [
        HotPixel(az_px=5 + 4 * n, el_px=el_px, dn=20_000.0)
        for n in range(8)
        for el_px in (5, 9, 27, 31)
    ]
    for pixel in hot:
        level[pixel.el_px, pixel.az_px] += pixel.dn
    image = frame(rig, *hot)

    # More of them than are passed over: without the dark frame, the star is never reached.
    assert StarSensor(rig.camera, rig.loops["right"]).find(image) is None
    star = StarSensor(with_dark(rig.camera, tmp_path, level), rig.loops["right"]).find(image)
    assert (star.az_px, star.el_px) == pytest.approx(STAR, abs=0.06)


@given(
    bad=st.lists(
        st.tuples(st.integers(0, 39), st.integers(0, 39)), min_size=1, max_size=12, unique=True
    ),
    seed=st.integers(0, 1000),
)
def test_an_even_frame_stays_even_wherever_the_bad_pixels_are(rig, tmp_path_factory, bad, seed):
    dark_dn = np.random.default_rng(seed).normal(1000.0, 30.0, (40, 40))
    image = np.rint(dark_dn + 500.0).astype(np.uint16)
    for place in bad:
        dark_dn[place], image[place] = np.nan, 65535
    camera = with_dark(rig.camera, tmp_path_factory.mktemp("dark"), dark_dn)
    try:
        dark = Dark(camera)
    except ConfigError as error:
        dark = None
        told = str(error)

    light_dn = np.full((40, 40), 500.0) if dark is None else dark.light(image, 0, 0, 40, 40)
    assert dark is not None or "is good; measure it anew" in told
    assert np.abs(light_dn - 500.0).max() <= 0.5
    if dark is not None:
        assert np.array_equal(dark.light(image, 7, 11, 9, 5), light_dn[7:16, 11:16])


def test_without_a_file_the_bias_is_subtracted_everywhere(rig):
    image = frame(rig)

    light_dn = Dark(rig.camera).light(image, 3, 4, 7, 7)

    assert np.array_equal(light_dn, image[3:10, 4:11] - rig.camera.bias_dn)


def saved(path, array):
    np.save(path, array)


WRONG = {
    "no file": (lambda _path: None, "cannot be read"),
    "text": (lambda path: path.write_text("dark"), "cannot be read"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "pickle": (lambda path: np.save(path, np.array([object()]), allow_pickle=True), "cannot be"),
    "shape": (lambda path: saved(path, np.ones((40, 41))), "must hold 40 x 40 floats"),
    "counts": (lambda path: saved(path, np.ones((40, 40), int)), "must hold 40 x 40 floats"),
    "all bad": (lambda path: saved(path, np.full((40, 40), np.nan)), "1600 pixels are bad"),
    "infinite": (lambda path: saved(path, np.full((40, 40), np.inf)), "pixels are bad"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_no_dark_frame_is_refused_in_one_line(tmp_path, name):
    make, said = WRONG[name]
    path = tmp_path / "dark.npy"
    make(path)

    with pytest.raises(ConfigError) as caught:
        read_dark(path, (40, 40))

    assert str(caught.value).startswith(f"camera.dark_file {path}: ")
    assert said in str(caught.value)
    assert "pickle" not in str(caught.value)
    assert str(caught.value).endswith("measure it again: fitctl sequence run dark")
    assert "\n" not in str(caught.value)
