"""The spot's width from frames that are known."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.identify import spot
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.identify.frames import TimedImage
from fitctl.identify.run import on_simulation
from fitctl.model.image.light import light_below


@pytest.fixture(scope="module")
def rig():
    return load_rig(default_rig_path())


def round_spot(shape, diameter_px, az_px, el_px):
    """A Gaussian spot's light on each pixel of a frame, as a part of all its light."""
    down, across = (
        np.diff(light_below((np.arange(size + 1) - 0.5 - place_px) / (diameter_px / 4)))
        for size, place_px in zip(shape, (el_px, az_px), strict=True)
    )
    return np.outer(down, across)


def frames(
    rig, diameter_px, count=300, *, stretched=1.0, electrons_per_dn=np.inf, seed=0, others=()
):
    """A star that wanders over a pixel, seen through the camera's noise.

    `others` move with the star: their offsets az and el in px, and their light in DN.
    """
    random = np.random.default_rng(seed)
    camera, loop = rig.camera, rig.stellar_loops["right"]
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
    for number in range(count):
        az_px, el_px = 20.0 + random.uniform(-0.5, 0.5, 2)
        if stretched == 1.0:
            light = round_spot(rows.shape, diameter_px, az_px, el_px)
        else:
            w = diameter_px / 2
            light = np.exp(
                -2 * (((columns - az_px) / (w * stretched)) ** 2 + ((rows - el_px) / w) ** 2)
            )
            light /= light.sum()
        light_dn = loop.star_flux_dn * light
        for az_off, el_off, flux_dn in others:
            light_dn += flux_dn * round_spot(
                rows.shape, diameter_px, az_px + az_off, el_px + el_off
            )
        if np.isfinite(electrons_per_dn):
            light_dn = random.poisson(light_dn * electrons_per_dn) / electrons_per_dn
        noise_dn = camera.pixel_noise_dn * random.standard_normal(light.shape)
        yield TimedImage(
            0.02 * number, np.rint(camera.bias_dn + light_dn + noise_dn).astype(np.uint16)
        )


@pytest.mark.parametrize("diameter_px", [2.2, 3.0, 3.4])
def test_a_width_is_found_within_its_uncertainty(rig, diameter_px):
    found = spot.analyse(rig, "right", frames(rig, diameter_px))

    assert found.diameter_px == pytest.approx(diameter_px, abs=4 * found.diameter_sd_px)
    assert found.diameter_sd_px < 0.002
    assert found.excess == pytest.approx(1.0, abs=0.05)


@pytest.mark.long
def test_the_uncertainty_is_that_of_repeated_measurements(rig):
    each = [spot.analyse(rig, "right", frames(rig, 3.0, seed=seed)) for seed in range(12)]
    told = np.mean([one.diameter_sd_px for one in each])

    assert np.std([one.diameter_px for one in each], ddof=1) == pytest.approx(told, rel=0.6)


def test_photons_add_to_the_uncertainty_and_are_no_misfit(rig):
    camera = rig.camera.model_copy(update={"electrons_per_dn": 1.0})
    noisy = rig.model_copy(update={"camera": camera})
    found = spot.analyse(noisy, "right", frames(rig, 3.0, electrons_per_dn=1.0))

    assert found.diameter_px == pytest.approx(3.0, abs=4 * found.diameter_sd_px)
    assert found.excess == pytest.approx(1.0, abs=0.1)


def with_bad_pixels(rig, folder, bad):
    """A rig with a dark file; `bad` indexes its rows and columns."""
    camera = rig.camera
    dark_dn = np.full((camera.height_px, camera.width_px), float(camera.bias_dn))
    dark_dn[bad] = np.nan
    np.save(folder / "dark.npy", dark_dn)
    return load_rig(default_rig_path(), [f"camera.dark_file={folder / 'dark.npy'}"])


@pytest.mark.parametrize("reads_dn", [0, pytest.param(1000, marks=pytest.mark.long), 65535])
@pytest.mark.parametrize(
    "bad",
    [[(20, 20)], pytest.param([(20, 21)], marks=pytest.mark.long), [(20, 20), (19, 22)]],
)
def test_bad_pixels_do_not_count(rig, tmp_path, bad, reads_dn):
    """The star's peak is in row 20, column 20."""
    rig = with_bad_pixels(rig, tmp_path, tuple(np.transpose(bad)))

    def spoilt(one):
        image = one.image.copy()
        image[tuple(np.transpose(bad))] = reads_dn
        return one._replace(image=image)

    found = spot.analyse(rig, "right", (spoilt(one) for one in frames(rig, 3.0, count=500)))

    assert found.diameter_px == pytest.approx(3.0, abs=0.002)
    assert found.excess == pytest.approx(1.0, abs=0.05)


def test_saturated_pixels_do_not_count(rig):
    images = (
        one._replace(image=np.minimum(one.image, 4095)) for one in frames(rig, 3.0, count=500)
    )
    device = rig.camera.device.model_copy(update={"pixel_format": "Mono12"})
    camera = rig.camera.model_copy(update={"device": device})
    found = spot.analyse(rig.model_copy(update={"camera": camera}), "right", images)

    assert found.diameter_px == pytest.approx(3.0, abs=0.002)


@pytest.mark.long
def test_frames_that_lack_half_of_the_star_s_pixels_do_not_count(rig, tmp_path):
    striped = with_bad_pixels(rig, tmp_path, np.s_[14:27:3, 14:27])
    spot.analyse(striped, "right", frames(rig, 3.0, count=200))

    rows = [row for row in range(14, 27) if row % 3]
    striped = with_bad_pixels(rig, tmp_path, np.ix_(rows, range(14, 27)))
    with pytest.raises(
        IdentifyError, match=r"0 whole frames show the star; on \d+ more, half of its pixels"
    ):
        spot.analyse(striped, "right", frames(rig, 3.0, count=200))


@pytest.mark.parametrize("sensor", ["centroid", "fit"])
@pytest.mark.parametrize("other", [(4.0, 0.0, 3000.0), (-3.5, 3.5, 3000.0), (0.0, 4.0, 8000.0)])
def test_other_spots_of_the_loop_are_part_of_the_model(tmp_path, other, sensor):
    az_px, el_px, flux_dn = other
    spots = f"[{{name='near',offset_px={{az={az_px},el={el_px}}},flux_dn={flux_dn}}}]"
    rig = load_rig(
        default_rig_path(),
        [
            f"loops.right.other_spots={spots}",
            f"loops.right.sensor={sensor}",
            "loops.right.spot_diameter_px=2.8",
        ],
    )
    found = spot.analyse(rig, "right", frames(rig, 3.0, count=500, others=[other]))

    assert found.diameter_px == pytest.approx(3.0, abs=0.002)
    assert found.flux_dn == pytest.approx(28_000, rel=0.002)
    assert found.excess == pytest.approx(1.0, abs=0.05)
    # What is plotted is the star alone.
    assert np.median(found.light[found.distance_px > 4.0]) == pytest.approx(0.0, abs=3e-4)


def test_a_spot_that_is_not_round_is_reported(rig):
    found = spot.analyse(rig, "right", frames(rig, 3.0, stretched=1.3))

    assert found.excess > spot.NOT_ROUND
    assert "not a round Gaussian" in found.lines()[-1]


def test_too_few_frames_are_an_error(rig):
    with pytest.raises(IdentifyError, match="50 whole frames show the star; expected at least 100"):
        spot.analyse(rig, "right", frames(rig, 3.0, count=50))


@pytest.mark.long
def test_on_the_instrument_it_finds_the_plants_spot(tmp_path):
    """The rig file believes in another width."""
    known = load_rig(default_rig_path(), ["loops.right.spot_diameter_px=2.6"])
    row = EXPERIMENTS["spot"]
    records = on_simulation(known, "right", "spot", row.plan(known, "right"), 1, lambda _part: None)
    found = row.from_records(known, "right", records)
    found.draw().savefig(tmp_path / "spot.png")

    assert found.diameter_px == pytest.approx(3.0, abs=0.003)
    assert found.fragment() == {
        "loops": {"right": {"spot_diameter_px": round(found.diameter_px, 4)}}
    }
    assert "rig file 2.6" in found.lines()[0]
    assert (tmp_path / "spot.png").stat().st_size > 10_000
