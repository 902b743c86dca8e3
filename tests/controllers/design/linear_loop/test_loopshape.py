import math

import numpy as np
import pytest

from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.eq20 import design_eq20, eq20_zpk
from fitctl.controllers.design.linear_loop.loopshape import (
    coarse_response,
    compensator_response,
    delayed,
    loop_shape,
    sampled_response,
)


def test_the_loop_of_eq_16_is_as_computed_for_it(fit):
    vernier = compensator_response(*eq20_zpk())
    shape = loop_shape(delayed(fit, vernier, coarse_response(fit)), 50.0)
    assert shape.crossover_hz == pytest.approx(3.7, abs=0.05)
    assert shape.phase_margin_deg == pytest.approx(28, abs=1.0)
    assert shape.gain_margin_db == pytest.approx(5.4, abs=0.1)
    assert shape.peak_sensitivity == pytest.approx(2.76, abs=0.03)
    assert shape.attenuation[1.0] == pytest.approx(6.6, abs=0.1)


def test_an_integrator_behind_a_delay_has_the_margins_of_the_textbook():
    k, delay_s = 2.0, 0.1
    shape = loop_shape(lambda w: k / (1j * w) * np.exp(-1j * w * delay_s), 25.0)
    assert shape.crossover_hz == pytest.approx(k / (2 * math.pi), rel=1e-3)
    assert shape.phase_margin_deg == pytest.approx(90 - math.degrees(k * delay_s), abs=0.1)
    assert shape.gain_margin_db == pytest.approx(
        20 * math.log10(math.pi / 2 / (k * delay_s)), abs=0.01
    )


def test_a_loop_below_one_everywhere_has_no_margins_to_lose():
    shape = loop_shape(lambda w: 0.01 / (1 + 1j * w), 25.0)
    assert math.isnan(shape.crossover_hz)
    assert shape.phase_margin_deg == math.inf
    assert shape.gain_margin_db == math.inf


def test_sampling_and_holding_eq_20_adds_to_the_delay_what_the_fractional_frame_makes_of_it(fit):
    """At mid-exposure the mirror follows the compensator two frames late, not 35 ms."""
    omega = 2 * math.pi * np.geomspace(0.01, 20, 50)
    sampled = sampled_response(design_eq20(fit), fit)(omega)
    z = np.exp(1j * omega * fit.period_s)
    warped = 2 / fit.period_s * (z - 1) / (z + 1) / 1j
    vernier = compensator_response(*eq20_zpk())(warped.real)
    walked = 0.25  # of the siderostat's newest step, at mid-exposure
    coarse = fit.coarse_per_s * fit.period_s / (z - 1) * (1 - walked + walked * z)
    assert sampled == pytest.approx((vernier + coarse) / z**2, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", DESIGNS)
def test_every_design_has_margins_at_both_rates(name, fit, flight):
    for basis in (fit, flight):
        shape = loop_shape(sampled_response(DESIGNS[name](basis), basis), 0.5 / basis.period_s)
        assert shape.phase_margin_deg > 20
        assert shape.gain_margin_db > 4
