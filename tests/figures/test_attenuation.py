import numpy as np
import pytest
from scipy.signal import lfilter

from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.daemon.run import run_info
from fitctl.figures.attenuation import (
    Rebuilt,
    attenuation,
    mean_spectra,
    rebuilt,
    spectra,
)
from fitctl.figures.rigs import with_controller
from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import tick_columns
from fitctl.logging.reading import tick_arrays
from fitctl.logging.writer import LogWriter
from fitctl.model.plant import Plant
from fitctl.simulation.simulation import Simulation

BACKLASH_PX = 0.37
NEAR_PX = np.array([2.0, 1.0])


@pytest.fixture(scope="module")
def held(rig):
    """A minute of the minimum-variance pair at work."""
    simulation = Simulation(
        with_controller(rig, "right", "minimum-variance"), seed=1, star_offset_px=NEAR_PX
    )
    simulation.acquire()
    simulation.run(60.0)
    return simulation


def white(seed, frames=200_000):
    return np.random.default_rng(seed).standard_normal((frames, 2))


def series_of(error_px, disturbance_px):
    return Rebuilt(0.02 * np.arange(len(error_px)), error_px, disturbance_px)


def test_a_known_filter_is_measured_as_it_is():
    disturbance = white(0)
    error = lfilter([0.25, 0.25], [1.0], disturbance, axis=0)  # 2.004 times less at 1 Hz

    found = attenuation(spectra(series_of(error, disturbance), 0.02), 1.0)

    assert found == pytest.approx(1 / (0.5 * np.cos(np.pi * 0.02)), rel=0.03)


def test_noise_that_the_loop_turns_into_motion_does_not_spoil_the_measure():
    """The error is S (d + n): however large n is, the ratio stays 1 / |S|."""
    disturbance, noise = white(1), 3 * white(2)
    both = disturbance + noise

    assert attenuation(spectra(series_of(0.2 * both, both), 0.02), 1.0) == pytest.approx(5.0)


@pytest.mark.long
def test_the_open_loop_is_rebuilt_to_what_the_star_does_above_stages_at_rest(rig, held):
    """The same seed on a plant that nobody touches is the truth."""
    alone = Plant(rig, [1], star_offset_px=NEAR_PX[None]).stellar_loops["right"]
    alone.advance(60.5)

    series = rebuilt(rig, "right", tick_columns(held.ticks))

    true_px = np.array([alone.spots_px(time_s)[0, 0] for time_s in series.time_s])
    difference_px = series.disturbance_px - true_px
    assert np.std(true_px, axis=0).min() > 0.1
    # From frame to frame, centroid noise of 0.01 px twice; over time, no more than the backlash.
    assert np.std(np.diff(difference_px, axis=0), axis=0).max() < 0.017
    assert np.ptp(difference_px, axis=0).max() < BACKLASH_PX + 0.1


@pytest.mark.long
def test_a_running_loop_attenuates_as_its_design_says(rig, held):
    its_basis = basis(rig, "right")
    design = DESIGNS["minimum-variance"](its_basis)
    wanted = abs(1 + sampled_response(design, its_basis)(np.array([2 * np.pi]))[0])

    measured = mean_spectra(
        [spectra(rebuilt(rig, "right", tick_columns(held.ticks)), rig.camera.period_s)]
    )

    assert attenuation(measured, 1.0) == pytest.approx(wanted, rel=0.2)


def test_a_log_tells_the_same_as_the_ticks_in_hand(rig, held, tmp_path):
    path = tmp_path / "held.mcap"
    info = run_info(rig, "simulated", now_s=0.0, designs={})
    with LogWriter(path, rig.logging) as log:
        log.write(info, info.wall_minus_monotonic_s)
        for tick in held.ticks:
            log.write(tick, tick.time_s + info.wall_minus_monotonic_s)

    from_log = rebuilt(rig, "right", tick_arrays(path, "right"))

    in_hand = rebuilt(rig, "right", tick_columns(held.ticks))
    np.testing.assert_array_equal(from_log.error_px, in_hand.error_px)
    np.testing.assert_array_equal(from_log.disturbance_px, in_hand.disturbance_px)


def test_ticks_without_vernier_are_refused_with_what_to_do(rig, held):
    ticks = {name: column[:100] for name, column in tick_columns(held.ticks).items()}

    with pytest.raises(IdentifyError, match="no frame in VERNIER; record"):
        rebuilt(rig, "right", ticks)


def test_a_stretch_too_short_for_a_spectrum_is_refused():
    with pytest.raises(IdentifyError, match=r"expected at least 8 s"):
        spectra(series_of(white(0, 100), white(0, 100)), 0.02)
