"""The spot's width from frames that are known."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.spot_fit import gaussian_shape
from fitctl.identify import spot
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.identify.frames import TimedImage
from fitctl.identify.run import on_simulation


@pytest.fixture(scope="module")
def rig():
    return load_rig(default_rig_path())


def frames(rig, diameter_px, count=300, *, stretched=1.0, electrons_per_dn=np.inf, seed=0):
    """A star that wanders over a pixel, seen through the camera's noise."""
    random = np.random.default_rng(seed)
    camera, loop = rig.camera, rig.stellar_loops["right"]
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
    for number in range(count):
        az_px, el_px = 20.0 + random.uniform(-0.5, 0.5, 2)
        if stretched == 1.0:
            light = np.zeros(rows.shape)
            inside = gaussian_shape(diameter_px, np.array(az_px - 20), np.array(el_px - 20))
            light[17:24, 17:24] = inside.reshape(7, 7)
        else:
            w = diameter_px / 2
            light = np.exp(
                -2 * (((columns - az_px) / (w * stretched)) ** 2 + ((rows - el_px) / w) ** 2)
            )
            light /= light.sum()
        light_dn = loop.star_flux_dn * light
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


def test_a_spot_that_is_not_round_is_reported(rig):
    found = spot.analyse(rig, "right", frames(rig, 3.0, stretched=1.3))

    assert found.excess > spot.NOT_ROUND
    assert "not a round Gaussian" in found.lines()[-1]


def test_too_few_frames_are_an_error(rig):
    with pytest.raises(IdentifyError, match="50 frames show the star; expected at least 100"):
        spot.analyse(rig, "right", frames(rig, 3.0, count=50))


@pytest.mark.long
def test_on_the_instrument_it_finds_the_plants_spot(tmp_path):
    """The rig file believes in another width."""
    known = load_rig(default_rig_path(), ["loops.right.spot_diameter_px=2.6"])
    row = EXPERIMENTS["spot"]
    records = on_simulation(known, "right", "spot", row.plan(known, "right"), 1, lambda _part: None)
    found = row.from_records(known, "right", records)
    found.plot(tmp_path / "spot.png")

    assert found.diameter_px == pytest.approx(3.0, abs=0.003)
    assert found.fragment() == {
        "loops": {"right": {"spot_diameter_px": round(found.diameter_px, 4)}}
    }
    assert "rig file 2.6" in found.lines()[0]
    assert (tmp_path / "spot.png").stat().st_size > 10_000
