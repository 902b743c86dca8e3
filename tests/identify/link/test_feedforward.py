"""The feedforward's matrix from a scan of the collector: against the truth, over seeds, and what is refused."""

import re

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.identify.backlash import behind_play
from fitctl.identify.errors import IdentifyError
from fitctl.identify.link import feedforward
from fitctl.model import air_path
from fitctl.model.hysteresis import displacement_series
from fitctl.model.optics import (
    mirror_from_stacks,
    rotation,
    scales,
    stack_volts,
)

RIG = load_rig(
    default_rig_path().parent / "fit-testbed.toml",
    ["loops.left.feedforward.matrix=[[1.02, 0.0], [0.0, 0.97]]"],
)
LOOP = RIG.stellar_loops["left"]
TRUTH = rotation(1.5) * 1.01
KNOWN = load_rig(
    default_rig_path().parent / "fit-testbed.toml",
    [f"loops.left.feedforward.matrix={TRUTH.round(3).tolist()}"],
)
SCAN_S = 40.0
SIX_CYCLES_HZ = 0.15


def behind(motor_px, width_arcsec, scale):
    half_px = width_arcsec / scale.sky_arcsec_per_px / 2
    return np.stack([behind_play(motor_px[:, axis], half_px) for axis in range(2)], axis=-1)


def air_px(random, times):
    """The star's motion by Eq. 8, shape (frames, 2)."""
    air = LOOP.vernier.air_path
    transition, gain = air_path.step_matrices(air, RIG.camera.period_s)
    state = (
        random.standard_normal((2, 2)) @ np.linalg.cholesky(air_path.stationary_covariance(air)).T
    )
    moved = []
    for _ in range(times):
        moved.append(state[:, 0])
        state = state @ transition.T + random.standard_normal((2, 2)) @ gain.T
    return np.array(moved)


def scan(seed, swing_arcsec=60.0, rig=RIG, jumps_arcsec=0.0):
    """Ticks of a scan: the link's siderostat swings, the own one follows by the rig file's matrix."""
    random, scale = np.random.default_rng(seed), scales(RIG, LOOP)
    period_s = RIG.camera.period_s
    times_s = 100.0 + np.arange(0.0, 2 * SCAN_S, period_s)
    since_s = times_s - times_s[0]
    phase = 2 * np.pi * SIX_CYCLES_HZ * since_s
    first, sine = (since_s < SCAN_S)[:, None], np.sin(phase)[:, None]
    swings = np.where([True, False], first * sine, ~first * sine)
    jitter = 0.1 * random.standard_normal(swings.shape)
    jumps = jumps_arcsec * (since_s % SCAN_S > SCAN_S / 2)[:, None] * (swings == 0)
    link_px = (swing_arcsec * swings + jitter + jumps) / scale.sky_arcsec_per_px
    own_px = -link_px @ np.array(rig.loops["left"].feedforward.matrix).T
    turned_px = behind(link_px, 1.0, scale) @ TRUTH.T + behind(own_px, 1.0, scale)
    moved_px = turned_px + air_px(random, len(times_s))
    fsm = LOOP.fsm
    wanted_rad = -np.roll(moved_px, 2, axis=0) / scale.mirror_px_per_rad
    wanted_rad[:2] = 0.0
    volts = stack_volts(wanted_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
    hysteresis = fsm.hysteresis
    displacement_m = displacement_series(
        volts - volts[0], np.array(hysteresis.half_widths_v), np.array(hysteresis.gains_m_per_v)
    )
    mirror_rad = mirror_from_stacks(displacement_m, fsm.stack_radius_m)
    noise_px = sensor_noise_px(rig.camera, rig.stellar_loops["left"], LOOP.star_flux_dn)
    star_px = np.array([12.0, 20.0]) + moved_px + scale.mirror_px(mirror_rad)
    star_px += noise_px * random.standard_normal(star_px.shape)
    link_sky = RIG.metrology_loops["metrology"].siderostat.sky_rad_per_motor_rad
    columns = {
        "mid_exposure_s": times_s,
        "fsm_written_s": times_s - 0.1 * period_s,
        "mode": np.full(len(times_s), "VERNIER"),
        "late": np.zeros(len(times_s), dtype=bool),
    }
    pairs = {
        "star_{}_px": star_px,
        "fsm_{}_rad": wanted_rad,
        "link_{}_rad": link_px / scale.sky_px_per_rad / link_sky,
        "siderostat_{}_rad": own_px / scale.motor_px_per_rad,
    }
    for name, pair in pairs.items():
        columns |= {name.format("az"): pair[:, 0], name.format("el"): pair[:, 1]}
    return columns | {f"stack{n + 1}_v": volts[:, n] for n in range(3)}


@pytest.mark.long
def test_the_interval_of_each_element_holds_the_truth_as_often_as_it_says():
    found = [feedforward.analyse(KNOWN, "left", scan(seed, rig=KNOWN)) for seed in range(40)]
    inside = [np.abs(one.matrix - TRUTH) < 1.96 * one.matrix_sd for one in found]
    assert 0.89 <= np.mean(inside) <= 0.99
    assert np.mean([one.matrix_sd for one in found]) < 0.003
    assert np.mean([one.excess for one in found]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("changed", ["camera.electrons_per_dn=1.0", "loops.left.sensor=fit"])
def test_the_noise_is_that_of_the_loop_s_sensor(changed):
    other = load_rig(
        default_rig_path().parent / "fit-testbed.toml",
        [f"loops.left.feedforward.matrix={TRUTH.round(3).tolist()}", changed],
    )
    found = feedforward.analyse(other, "left", scan(1, rig=other))
    assert np.all(np.abs(found.matrix - TRUTH) < 4 * found.matrix_sd)
    assert 0.75 < found.excess < 1.1  # with the fit, the drift that the rig file expects counts


def on_a_busy_computer(seed, stalls=15):
    """A scan in which the link's encoders were read a frame later than their readings say, 0.2 s each time."""
    random, ticks = np.random.default_rng(seed), scan(seed, rig=KNOWN)
    since_s = ticks["mid_exposure_s"] - ticks["mid_exposure_s"][0]
    begun_s = 2 * SCAN_S * random.random((stalls, 1))
    ticks["late"] = ((since_s > begun_s) & (since_s < begun_s + 0.2)).any(axis=0)
    for name in ("link_az_rad", "link_el_rad"):
        ticks[name] = np.where(ticks["late"], np.roll(ticks[name], 1), ticks[name])
    return ticks


@pytest.mark.long
def test_readings_with_wrong_times_are_left_out_and_told():
    found = [feedforward.analyse(KNOWN, "left", on_a_busy_computer(seed)) for seed in range(40)]
    errors = np.array([(one.matrix - TRUTH) / one.matrix_sd for one in found])
    assert np.mean(np.abs(errors) < 3.0) >= 0.97
    assert np.mean([np.diag(one.matrix - TRUTH) for one in found]) == pytest.approx(0, abs=0.001)
    assert all(0.0 < one.left_out < 0.1 for one in found)
    assert re.search(
        r"\d\.\d% of them left out as outliers; \d\.\d% of the ticks", found[0].lines()[-1]
    )


@pytest.mark.long
def test_what_the_mirror_makes_up_for_is_less_certain_and_worth_another_scan():
    far, near = (
        feedforward.analyse(RIG, "left", scan(1)),
        feedforward.analyse(KNOWN, "left", scan(1, rig=KNOWN)),
    )
    assert np.all(np.abs(far.matrix - TRUTH) < 3 * far.matrix_sd)
    assert far.matrix_sd.max() > 1.5 * near.matrix_sd.max()
    assert "run it again with this matrix" in far.lines()[2]
    assert "again" not in near.lines()[2]


def test_the_fragment_has_the_matrix_and_the_whole_gain():
    found = feedforward.analyse(RIG, "left", scan(1))
    section = found.fragment()["loops"]["left"]["feedforward"]
    assert section["gain"] == 1.0
    assert np.array(section["matrix"]) == pytest.approx(TRUTH, abs=0.01)
    assert "rig file's gain times matrix" in found.lines()[2]


@pytest.mark.long
def test_an_axis_that_takes_up_its_play_while_it_rests_does_not_count_as_swinging():
    quiet = feedforward.analyse(KNOWN, "left", scan(1, swing_arcsec=8.0, rig=KNOWN))
    taken_up = scan(1, swing_arcsec=8.0, rig=KNOWN, jumps_arcsec=1.0)
    found = feedforward.analyse(KNOWN, "left", taken_up)
    assert found.frames > 0.9 * quiet.frames
    assert np.all(np.abs(found.matrix - TRUTH) < 4 * found.matrix_sd)


@pytest.mark.long
def test_it_is_plotted(tmp_path):
    found = feedforward.analyse(RIG, "left", scan(1))
    found.draw().savefig(tmp_path / "feedforward.png")
    assert (tmp_path / "feedforward.png").stat().st_size > 10_000


def test_what_shows_nothing_is_refused():
    with pytest.raises(IdentifyError, match="loop right has no link"):
        feedforward.analyse(RIG, "right", scan(1))
    with pytest.raises(IdentifyError, match=r"swung by .* expected at least 10 along each"):
        feedforward.analyse(RIG, "left", scan(1, swing_arcsec=4.0))
    lost = scan(1)
    lost["star_az_px"][::2] = np.nan
    with pytest.raises(IdentifyError, match="the star is on 2000 of 4000 frames"):
        feedforward.analyse(RIG, "left", lost)
    shaken = scan(1)
    shaken["star_az_px"] += 0.2 * np.random.default_rng(2).standard_normal(
        len(shaken["star_az_px"])
    )
    with pytest.raises(IdentifyError, match="is left unexplained"):
        feedforward.analyse(RIG, "left", shaken)


def test_a_link_that_moves_in_jerks_is_refused():
    jerky = scan(1)
    stairs = np.abs(np.arange(len(jerky["mode"])) // 50 % 10 - 5)  # a fifth of the way each second
    jerky["link_az_rad"] = np.ptp(jerky["link_az_rad"]) * stairs / 5
    with pytest.raises(IdentifyError, match="moves in az only by short jerks"):
        feedforward.analyse(RIG, "left", jerky)


@pytest.mark.parametrize("change", [lambda t: t / 1e9, lambda t: t * 0.0, lambda t: t * 1e9])
def test_times_that_cannot_be_of_one_scan_are_refused(change):
    ticks = scan(1)
    for name in ("mid_exposure_s", "fsm_written_s"):
        ticks[name] = change(ticks[name])
    with pytest.raises(IdentifyError, match="the times of the frames of loop left"):
        feedforward.analyse(RIG, "left", ticks)


def test_a_loop_without_the_mirror_s_hysteresis_uses_the_commanded_angles():
    linear = RIG.model_copy(
        update={
            "loops": {
                **RIG.loops,
                "left": LOOP.model_copy(
                    update={"fsm": LOOP.fsm.model_copy(update={"hysteresis": None})}
                ),
            }
        }
    )
    found = feedforward.analyse(linear, "left", scan(1))
    # The mirror goes less far than commanded; what it undid comes out wrong by that part.
    assert found.matrix == pytest.approx(TRUTH, abs=0.02)
