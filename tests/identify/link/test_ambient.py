"""The photodiodes' voltages without the beam: against the truth, over seeds, and what is refused."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.identify.errors import IdentifyError
from fitctl.identify.link import ambient

RIG = load_rig(default_rig_path().parent / "fit-testbed.toml")
TRUTH_V = np.array([0.021, 0.034, 0.0, 0.0172])


def samples(seed, noise_v=0.001, light_v=0.0):
    random = np.random.default_rng(seed)
    volts = TRUTH_V + light_v + noise_v * random.standard_normal((600, 4))
    sampled_s = 0.02 * np.arange(600.0)
    columns = {f"diode_{side}_v": volts[:, n] for n, side in enumerate(ambient.SIDES)}
    sampled_s[::7] = np.nan  # ticks without a sample
    return columns | {"sampled_s": sampled_s}


def test_the_interval_holds_the_truth_as_often_as_it_says():
    found = [ambient.analyse(RIG, "metrology", samples(seed)) for seed in range(200)]
    inside = [np.abs(one.ambient_v - TRUTH_V) < 1.96 * one.sd_v for one in found]
    assert 0.93 <= np.mean(inside) <= 0.97
    assert np.mean([one.noise_v for one in found]) == pytest.approx(0.001, rel=0.01)


def test_the_fragment_has_no_voltage_below_zero():
    found = next(
        one
        for one in (ambient.analyse(RIG, "metrology", samples(seed)) for seed in range(9))
        if one.ambient_v[2] < 0
    )
    given = found.fragment()["loops"]["metrology"]["sensor"]["ambient_v"]
    assert given[2] == 0.0
    assert given == pytest.approx(TRUTH_V.tolist(), abs=3e-4)


def test_a_light_that_changes_slowly_makes_the_interval_wider():
    quiet, drifting = samples(1), samples(1)
    drifting["diode_az_plus_v"] = drifting["diode_az_plus_v"] + np.linspace(0.0, 0.002, 600)
    wider = ambient.analyse(RIG, "metrology", drifting).sd_v[0]
    assert wider > 3 * ambient.analyse(RIG, "metrology", quiet).sd_v[0]


def test_it_is_plotted(tmp_path):
    ambient.analyse(RIG, "metrology", samples(1)).draw().savefig(tmp_path / "ambient.svg")
    assert (tmp_path / "ambient.svg").stat().st_size > 10_000


def test_what_is_not_ambient_light_is_refused():
    with pytest.raises(IdentifyError, match="is the laser blocked"):
        ambient.analyse(RIG, "metrology", samples(1, light_v=2.0))
    with pytest.raises(IdentifyError, match="is the laser blocked"):
        ambient.analyse(RIG, "metrology", samples(1, noise_v=0.01))
    with pytest.raises(IdentifyError, match="loop left has no photodiodes"):
        ambient.analyse(RIG, "left", samples(1))
    few = {name: column[:50] for name, column in samples(1).items()}
    with pytest.raises(IdentifyError, match="expected at least 100"):
        ambient.analyse(RIG, "metrology", few)


def test_voltages_that_are_no_numbers_are_refused():
    broken = samples(1)
    broken["diode_el_plus_v"][1] = np.nan
    with pytest.raises(IdentifyError, match="is the laser blocked"):
        ambient.analyse(RIG, "metrology", broken)
