"""Dark frames: bias and noise that are known come back; light is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.sequences.dark import measure_dark


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
