"""A run of the whole testbed: two stars, a metrology loop, and the fringes that they are for."""

import json

import numpy as np
import pytest
from samples.report_samples import record
from test_page import Reader

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import MetrologyTick, Overlap
from fitctl.messages.modes import Mode
from fitctl.report.compare import make_comparison
from fitctl.report.findings import StarFindings, find
from fitctl.report.fringes import density
from fitctl.report.make import make_report
from fitctl.report.run import find_run
from fitctl.report.selection import select_samples

pytestmark = pytest.mark.long

PERIOD_S = 0.02


@pytest.fixture(scope="module")
def testbed():
    return load_rig(default_rig_path().parent / "fit-testbed.toml")


@pytest.fixture(scope="module")
def run_of_three(testbed, tmp_path_factory):
    """The records of the metrology loop and of the overlap, and the log's findings."""
    path = tmp_path_factory.mktemp("testbed") / "testbed.mcap"
    recorded = []

    def course(simulation):
        to_log = simulation._on_record
        simulation._on_record = lambda what: (recorded.append(what), to_log(what))
        simulation.acquire()
        simulation.run(60.0)

    record(testbed, path, course)
    return recorded, find(find_run([path]))


def test_each_loop_is_evaluated_in_its_own_unit(run_of_three, testbed):
    _, findings = run_of_three

    units = {name: loop.quantity.unit for name, loop in findings.loops.items()}

    assert units == {"right": "px", "metrology": "arcsec", "left": "px"}
    assert list(findings.loops) == list(testbed.loops)
    assert findings.loops["metrology"].requirement == 1.0
    assert not isinstance(findings.loops["metrology"], StarFindings)
    assert {loop.verdict.word for loop in findings.loops.values()} == {"met"}


def test_the_beam_s_residual_is_that_of_the_samples_in_locked(run_of_three):
    recorded, findings = run_of_three
    ticks = [one for one in recorded if isinstance(one, MetrologyTick)]
    locked = [tick for tick in ticks if tick.mode_number == Mode.LOCKED]
    settled = [tick for tick in locked if tick.time_s >= locked[0].time_s + 10.0]
    errors = np.array([tick.beam_el_arcsec for tick in settled])

    loop = findings.loops["metrology"]

    rms_arcsec = np.sqrt(np.nanmean(errors**2))
    assert loop.residual["el"].rms == pytest.approx(rms_arcsec, rel=1e-3)
    assert loop.mode_s["LOCKED"] == pytest.approx(len(locked) * PERIOD_S, abs=0.1)
    assert loop.counts["frames"] == sum(tick.number >= 0 for tick in ticks)


def test_the_visibility_is_that_of_frames_on_which_both_loops_are_evaluated(run_of_three):
    recorded, findings = run_of_three
    from_s = max(
        findings.loops[name].ticks["mid_exposure_s"][findings.loops[name].selection.rows[0]]
        for name in ("left", "right")
    )
    start_s = findings.run.start_ns / 1e9
    offset_s = findings.fringes.overlap["time_s"][0] - next(
        one.time_s for one in recorded if isinstance(one, Overlap)
    )
    both = [
        one
        for one in recorded
        if isinstance(one, Overlap) and one.time_s + offset_s >= from_s - PERIOD_S / 2
    ]

    figures = findings.fringes.figures

    assert start_s > 0
    assert figures.judged_s == pytest.approx(len(both) * PERIOD_S, abs=0.1)
    assert figures.visibility_mean == pytest.approx(
        np.nanmean([one.visibility for one in both]), abs=1e-4
    )
    assert figures.tilt_std_el_arcsec == pytest.approx(
        np.nanstd([one.tilt_el_arcsec for one in both]), rel=0.01
    )
    assert 0.95 < figures.visibility_p5 < figures.visibility_mean < 1


def test_the_spectrum_of_the_tilt_adds_up_to_its_variance(run_of_three):
    _, findings = run_of_three
    fringes = findings.fringes

    found = fringes.density.sum(axis=0) * fringes.frequency_hz[0]

    figures = fringes.figures
    std = np.array([figures.tilt_std_az_arcsec, figures.tilt_std_el_arcsec])
    np.testing.assert_allclose(np.sqrt(found), std, rtol=0.1)


def test_the_density_of_a_sine_is_at_its_frequency_and_short_pieces_are_left_out():
    time_s = PERIOD_S * np.arange(3000)
    sine = np.sin(2 * np.pi * 2.0 * time_s)[:, None]
    rows = np.concatenate([np.arange(2000), np.arange(2200, 2400)])  # 40 s, and 4 s after a gap

    frequency_hz, power = density(time_s, sine, rows, PERIOD_S)
    none_hz, none = density(time_s, sine, rows[2000:], PERIOD_S)

    assert frequency_hz[power[:, 0].argmax()] == pytest.approx(2.0, abs=0.07)
    assert power.sum() * frequency_hz[0] == pytest.approx(0.5, rel=0.02)
    assert (none_hz.shape, none.shape) == ((0,), (0, 1))


def test_ticks_without_a_sample_do_not_count_and_samples_without_a_beam_are_missing():
    frames = 2000
    volts, beam = np.full(frames, 5.0, np.float32), np.zeros(frames, np.float32)
    volts[1000:1100:2] = np.nan  # the photodiodes' answer came late: every second tick has none
    beam[1000:1100:2] = np.nan
    beam[1400:1500] = np.nan  # 2 s without a beam
    ticks = {
        "time_s": PERIOD_S * np.arange(frames),
        "mode_number": np.full(frames, Mode.LOCKED, np.int8),
        "diode_az_plus_v": volts,
        "beam_az_arcsec": beam,
    }

    found = select_samples(ticks, PERIOD_S)

    assert found.held_s == pytest.approx((frames - 50) * PERIOD_S)
    assert found.measured_fraction == pytest.approx(1 - 100 / (frames - 500 - 50))
    assert [len(piece) for piece in found.pieces] == [850, 500]


def test_the_page_has_all_three_loops_and_their_fringes(run_of_three, tmp_path):
    _, findings = run_of_three

    page = make_report(findings, tmp_path).read_text()

    read = Reader(page)
    text = " ".join(read.text)
    assert read.open == []
    assert len(read.ids) == len(set(read.ids))
    for part in (
        "of 1 arcsec RMS",
        "of 0.1 px RMS",
        "RMS of the worse axis, 10 s at a time",
        "Error in LOCKED",
        "Fringe visibility that the tilt leaves",
        "Spectrum of the tilt",
        "visibility, mean",
        "The star comes over the link that loop metrology holds",
    ):
        assert part in text
    assert page.count("<svg") == 1 + 8 + 4 + 8 + 2
    figures = json.loads((tmp_path / "report.json").read_text())
    assert figures["fringes"]["visibility_mean"] == findings.fringes.figures.visibility_mean
    assert figures["loops"]["metrology"]["requirement_arcsec"] == 1.0
    assert set(figures["loops"]["metrology"]["residual"]["az"]) == {
        "rms_arcsec", "low_arcsec", "high_arcsec", "independent"
    }  # fmt: skip
    assert "rms_px" in figures["loops"]["left"]["residual"]["az"]


def test_the_error_budget_of_a_star_behind_a_link_is_explained(run_of_three):
    """The link's siderostat is a part of the loop, and no disturbance."""
    _, findings = run_of_three
    ((one,), (other,)) = (findings.loops[name].rejections for name in ("right", "left"))

    for budget in (one.budget, other.budget):
        assert budget.as_expected
        assert abs(budget.fractions["unexplained"]) < 0.2
        assert sum(budget.fractions.values()) == pytest.approx(1.0)


def test_a_testbed_that_was_off_makes_a_page_without_fringes(testbed, tmp_path):
    path = tmp_path / "off.mcap"
    record(testbed, path, lambda simulation: simulation.run(1.0))

    findings = find(find_run([path]))
    page = make_report(findings, tmp_path).read_text()

    assert findings.word == "not known"
    assert "no time in LOCKED can be evaluated" in page
    assert Reader(page).open == []


def test_a_night_of_one_loop_and_one_of_three_stand_side_by_side(run_of_three, rig, tmp_path):
    path = tmp_path / "one.mcap"
    record(rig, path, lambda simulation: simulation.run(1.0))

    page = make_comparison([run_of_three[1], find(find_run([path]))], tmp_path).read_text()

    read = Reader(page)
    text = " ".join(read.text)
    assert read.open == []
    assert "RMS az, arcsec (95 %)" in text
    assert "RMS of the measured error in LOCKED, el" in page
    assert len(read.ids) == len(set(read.ids))
