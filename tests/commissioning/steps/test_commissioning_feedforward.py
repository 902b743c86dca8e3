"""The feedforward of a loop behind a link: what is measured, corrected or named, on the virtual clock."""

import numpy as np
import pytest

from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps import link
from fitctl.commissioning.tasks import tasks_of
from fitctl.config import default_rig_path, load_rig
from fitctl.identify.link import feedforward
from fitctl.identify.link.step_record import gather_step
from fitctl.logging.records import SequenceAttempt, Tick
from fitctl.sequences.contact import Contact
from fitctl.sequences.links import SimulatedLink
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.steps import Acquire, Collector, Wait

RIG_PATH = default_rig_path().with_name("fit-testbed.toml")
NEAR = (
    "plant.loops.right.star_offset_sky_arcsec_max=20.0",
    "plant.loops.left.star_offset_sky_arcsec_max=20.0",
    "plant.loops.metrology.beam_offset_sky_arcsec_max=20.0",
)
TRUTH = np.eye(2)


def site_of(*settings):
    rig = load_rig(RIG_PATH, settings)
    return Site(rig, "left", lambda _line: None, RIG_PATH, settings)


def matrix(az, el):
    return f"loops.left.feedforward.matrix=[[{az}, 0.0], [0.0, {el}]]"


def scanned(found=TRUTH, rms_px=0.02, sd=0.002, late=0.0):
    """What a scan gave."""
    nothing = np.empty((0, 2))
    result = feedforward.FeedforwardResult(
        loop="left",
        matrix=np.array(found),
        matrix_sd=np.full((2, 2), sd),
        before=TRUTH,
        px_per_mm=0.015,
        excess=1.0,
        frames=4000,
        left_out=0.0,
        late=late,
        link_arcsec=nothing,
        turned_arcsec=nothing,
        left_arcsec=nothing,
    )
    return link.Scanned(result, rms_px, rms_px)


def simulated_scan(site, scan, *overrides):
    """As `link.scanned`, by a supervisor on the virtual clock; two cycles are enough."""
    rig = load_rig(site.rig_path, [*NEAR, *site.overrides, *overrides])
    kept = []

    def keep(simulation):
        add = simulation._on_record

        def record(one):
            if isinstance(one, Tick | SequenceAttempt):
                kept.append(one)
            add(one)

        simulation._on_record = record

    contact = Contact(SimulatedLink(rig, 1, keep), rig, "commissioning", 4)
    attempts = run_steps(
        Runner(contact),
        [
            Collector(action="reference"),
            Acquire(),
            Wait(duration_s=3.0),
            scan.model_copy(update={"cycles": 2}),
        ],
    )
    figures = attempts[-1].figures_json
    ticks = gather_step(kept, Tick, site.name, "collector_scan")
    return link.scanned_from(feedforward.analyse(rig, site.name, ticks), figures)


@pytest.fixture
def coupling(monkeypatch):
    """The step by a rig file, with a scan that gives this matrix whatever the rig file has."""

    def check(*settings, found=TRUTH):
        monkeypatch.setattr(link, "scanned", lambda *_: scanned(found, sd=0.1))
        return link.check_coupling(site_of(*settings))

    return check


@pytest.mark.long
def test_without_the_feedforward_a_small_scan_shows_how_far_the_link_turns_the_star(monkeypatch):
    monkeypatch.setattr(link, "scanned", simulated_scan)
    outcome = link.check_coupling(site_of(matrix(-1.0, -1.0)))
    section = outcome.found["loops"]["left"]["feedforward"]
    assert np.array(section["matrix"]) == pytest.approx(TRUTH, abs=0.1)


def test_a_matrix_that_is_nearly_right_stays_for_the_feedforward_s_own_step(coupling):
    outcome = coupling(matrix(1.05, 0.95))
    assert outcome.state == "passed"
    assert outcome.figures["difference"] < 0.15


@pytest.mark.parametrize("wrong", [(-1.0, -1.0), (1.3, 1.3), (1.0, -1.0), (0.0, 0.0)])
def test_a_matrix_that_the_mirror_could_not_make_up_for_is_replaced(coupling, wrong):
    outcome = coupling(matrix(*wrong))
    assert outcome.state == "measured"
    section = outcome.found["loops"]["left"]["feedforward"]
    assert section["gain"] == 1.0
    assert np.array(section["matrix"]) == pytest.approx(TRUTH, abs=0.1)


def test_a_star_that_hardly_moves_with_the_link_is_named(coupling):
    with pytest.raises(
        StepError, match=r"turns the star by 0\.\d+ to 0\.\d+ times .* expected 0\.5 to 2"
    ):
        coupling(found=0.3 * TRUTH)


@pytest.mark.long
def test_a_scale_that_is_wrong_by_ten_percent_is_corrected(monkeypatch):
    monkeypatch.setattr(link, "scanned", simulated_scan)
    outcome = link.check_feedforward(site_of(matrix(1.1, 1.1)))
    assert outcome.state == "corrected"
    corrected = outcome.found["loops"]["left"]["feedforward"]["matrix"]
    assert np.array(corrected) == pytest.approx(TRUTH, abs=0.02)
    assert outcome.figures["rms_az_px"] > 0.03


@pytest.mark.long
def test_with_the_right_matrix_the_star_is_held_while_the_collector_moves(monkeypatch):
    monkeypatch.setattr(link, "scanned", simulated_scan)
    outcome = link.check_feedforward(site_of())
    assert outcome.state == "passed"
    assert outcome.figures["rms_az_px"] < 0.03


@pytest.fixture
def scan_of(monkeypatch):
    """The step, with a scan that gives this matrix and RMS."""

    def give(found, rms_px, **others):
        monkeypatch.setattr(link, "scanned", lambda *_: scanned(found, rms_px, **others))
        return link.check_feedforward(site_of())

    return give


def test_a_matrix_is_replaced_where_the_scan_excludes_it_and_it_matters(scan_of):
    assert scan_of([[1.009, 0.0], [0.0, 1.0]], 0.02).state == "passed"
    assert scan_of([[1.012, 0.0], [0.0, 1.0]], 0.02, sd=0.005).state == "passed"
    assert scan_of([[1.012, 0.0], [0.0, 1.0]], 0.02).state == "corrected"


def test_a_star_that_the_right_matrix_does_not_hold_is_named_with_the_requirement(scan_of):
    with pytest.raises(
        StepError, match=r"held to 0\.300 px RMS; the requirement is 0\.1 px; .* backlash"
    ):
        scan_of([[1.0, 0.0], [0.0, 1.0]], 0.3)


def test_a_star_that_late_ticks_let_go_is_not_blamed_on_the_backlash(scan_of):
    with pytest.raises(StepError, match=r"32% of the ticks were late, so let nothing else run"):
        scan_of([[1.0, 0.0], [0.0, 1.0]], 0.3, late=0.32)


def test_only_a_loop_with_a_feedforward_has_the_steps_and_is_accepted_after_them():
    needs = {task.name: list(task.needs()) for task in tasks_of(load_rig(RIG_PATH))}
    assert "metrology.collector" in needs["left.coupling"]
    assert "left.coupling" in needs["left.feedforward"]
    assert "left.feedforward" in needs["left.acceptance"]
    assert "right.feedforward" not in needs
    assert "right.feedforward" not in needs["right.acceptance"]
    assert not any("coupling" in task.name for task in tasks_of(load_rig(default_rig_path())))


def test_what_a_scan_moves_is_printed_before():
    assert "by 0.39 mm to either side" in link.coupling_moves(site_of())
    assert "follows it by 61.9 arcsec" in link.feedforward_moves(site_of())
