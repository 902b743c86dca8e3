"""The metrology loop against its backlash: what describing functions say, and what the loop then does."""

import math

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.beam import fast_onset, margins, slow_swing
from tests.loop.beam_bench import Bench

RIG = load_rig(default_rig_path().with_name("fit-testbed.toml"))
LOOP = RIG.metrology_loops["metrology"]
TIMES = LOOP.sensor.link_delay_s, RIG.camera.period_s
SWING = LOOP.hold.crossover_hz, LOOP.hold.second_integrator_hz, *TIMES


def test_the_shipped_crossover_is_less_than_half_of_what_swings_with_the_play():
    assert LOOP.hold.crossover_hz < 0.5 * fast_onset(*TIMES).gain_hz


def test_the_shipped_loop_has_margins():
    phase_deg, peak = margins(*SWING)
    assert phase_deg > 50
    assert peak < 2


def test_a_longer_link_allows_less():
    assert fast_onset(0.1, 0.02).gain_hz < 0.5 * fast_onset(0.025, 0.02).gain_hz


def test_without_a_second_integrator_there_is_no_slow_swing():
    assert slow_swing(LOOP.hold.crossover_hz, 0.0, *TIMES) is None


@pytest.mark.long
def test_a_slower_second_integrator_makes_a_smaller_swing():
    swings = [slow_swing(2.0, second_hz, *TIMES).beam_half_widths for second_hz in (0.05, 0.1, 0.2)]
    assert swings == sorted(swings)


@pytest.mark.long
def test_the_loop_swings_at_rest_as_its_describing_function_says():
    bench = Bench("loops.metrology.sensor.noise_v=1e-6", offset_arcsec=(5.0, 3.0)).held()
    bench.run(20.0)
    beam = []
    for _ in range(3000):
        bench.tick()
        beam.append(bench.beam_arcsec()[0])
    swing = slow_swing(*SWING)
    amplitude_arcsec = swing.beam_half_widths * LOOP.siderostat.backlash_sky_arcsec / 2
    assert np.std(beam) == pytest.approx(amplitude_arcsec / math.sqrt(2), rel=0.35)
    spectrum = np.abs(np.fft.rfft(np.array(beam) - np.mean(beam)))
    hz = np.fft.rfftfreq(len(beam), RIG.camera.period_s)[int(spectrum.argmax())]
    assert hz == pytest.approx(swing.frequency_hz, rel=0.25)
