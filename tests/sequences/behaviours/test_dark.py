"""Dark frames: bias and noise that are known come back; light is refused."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl import Instrument
from fitctl.config import default_rig_path, load_rig
from fitctl.messages.modes import Mode
from fitctl.sequences.behaviours.dark import _calibration, measure_dark
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.simulation import Simulation

NEAR = ["plant.loops.right.star_offset_sky_arcsec_max=5.0"]


@settings(max_examples=25)
@given(
    bias=st.floats(100.0, 5000.0),
    noise=st.floats(1.0, 50.0),
    pattern=st.floats(0.0, 20.0),
    bright=st.integers(0, 20),
    seed=st.integers(0, 2**32 - 1),
)
def test_bias_and_noise_that_are_known_come_back(bias, noise, pattern, bright, seed):
    rng = np.random.default_rng(seed)
    pixels = bias + pattern * rng.standard_normal((40, 40))
    pixels.flat[:bright] = bias + 5 * pattern + 50 * noise
    stack = pixels + noise * rng.standard_normal((100, 40, 40))

    found = measure_dark(stack)

    spread = np.hypot(pattern, noise / 10)
    assert found["bias_dn"] == pytest.approx(bias, abs=0.2 * spread)
    assert found["noise_dn"] == pytest.approx(noise, rel=0.02)
    assert found["fixed_pattern_dn"] == pytest.approx(pattern, abs=0.15 * spread + 0.06 * noise)
    assert found["bright_pixels"] >= bright
    if pattern <= noise:
        assert found["bright_pixels"] == bright


def test_a_camera_that_shows_no_noise_has_that_of_whole_numbers():
    found = {"bias_dn": 20.0, "noise_dn": 0.0}
    calibration = _calibration(load_rig(default_rig_path()), found, np.full((40, 40), 20.0), "")

    assert calibration.fragment["camera"]["pixel_noise_dn"] == 0.29


def test_a_camera_that_is_not_as_the_rig_file_says_is_found_out(tried):
    run = tried("plant.loops.right.star_offset_sky_arcsec_max=200.0", seed=0)
    camera = run.rig.camera.model_copy(update={"bias_dn": 700.0})
    told = run.rig.model_copy(update={"camera": camera})
    run.rig = told

    run({"step": "standby"}, {"step": "dark", "frames": 60})

    assert run.outcomes() == ["done", "done"]
    found = run.figures()
    assert found["bias_dn"] == pytest.approx(1000.0, abs=2.0)
    assert found["noise_dn"] == pytest.approx(20.0, rel=0.05)
    assert "bias 1000" in run.attempts[-1].message
    assert "(rig file 700)" in run.attempts[-1].message


def test_a_star_on_the_frame_is_no_dark_frame(tried):
    run = tried()

    run({"step": "standby"}, {"step": "dark", "frames": 60})

    assert run.outcomes() == ["done", "failed"]
    assert "a star is on the frame" in run.error


HOT = "plant.hot_pixels=[{az_px=22, el_px=20, dn=3000.0}, {az_px=30, el_px=9, dn=65000.0}]"


def offset_px(*overrides):
    """How far from its target the star is truly held."""
    rig = load_rig(default_rig_path(), [*NEAR, *overrides])
    simulation = Simulation(rig, 4, history_s=60.0)
    simulation.acquire()
    simulation.run(50.0)
    true_px = simulation.plants["right"].history_px(25.0, 50.0)[:, 0, 0]
    assert simulation.supervisor.loops["right"].mode is Mode.VERNIER
    return true_px.mean(axis=0) - simulation.supervisor.loops["right"].target_px


@pytest.mark.long
def test_a_dark_frame_that_was_measured_is_used_and_the_star_is_held_in_its_place(tmp_path):
    aside = load_rig(default_rig_path(), [HOT])
    with Instrument(aside, simulate=True, seed=1) as instrument:
        instrument.standby()
        figures = instrument.dark(60)
        (fragment,) = instrument.write_calibrations(tmp_path)

    assert figures["bright_pixels"] == 2
    text = fragment.read_text()
    assert "bad pixels, which are filled in from their neighbours: az 30, el 9" in text
    camera = tomllib.loads(text)["camera"]
    assert camera["dark_file"] == "fit-mock-dark.npy"
    assert camera["bias_dn"] == pytest.approx(1000.0, abs=1.0)

    # Beside a rig file, the fragment's file is found from wherever fitctl is run.
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(f'include = ["{fragment.name}"]\nbase = "{default_rig_path()}"\n')
    dark_file = load_rig(rig_file).camera.dark_file
    assert dark_file == str(tmp_path / "fit-mock-dark.npy")

    clean = offset_px()
    assert np.linalg.norm(offset_px(HOT) - clean) > 0.15
    assert np.linalg.norm(offset_px(HOT, f"camera.dark_file={dark_file}") - clean) < 0.01


def test_a_batch_leaves_pixels_that_differ_to_the_simulation(tmp_path):
    np.save(tmp_path / "dark.npy", np.full((40, 40), 1000.0))
    for override in (HOT, f"camera.dark_file={tmp_path / 'dark.npy'}"):
        with pytest.raises(BatchRefusalError, match="pixels differ"):
            Batch(load_rig(default_rig_path(), [override]))
