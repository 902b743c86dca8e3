"""What identifications and designs make of the rig file: only what is measured to be different is taken."""

import dataclasses

import pytest
from commissioning.motor_bench import RIG, site_of

from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import identified
from fitctl.commissioning.steps.identified import _COMPARED, check_design, identification_moves
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.margins import Required
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.identify.run import on_simulation


@pytest.fixture(scope="module")
def delay():
    drives = EXPERIMENTS["delay"].plan(RIG, "right")
    records = on_simulation(RIG, "right", "delay", drives, 1, lambda _part: None)
    return EXPERIMENTS["delay"].from_records(RIG, "right", records)


@pytest.mark.long
@pytest.mark.parametrize(("later_s", "differs"), [(0.0, False), (0.02, True)])
def test_a_delay_is_taken_where_it_is_measured_to_differ(delay, later_s, differs):
    finding = dataclasses.replace(delay, delay_s=delay.delay_s + later_s)
    figures, taken = _COMPARED["delay"](site_of(), finding)
    assert taken is differs
    assert figures["delay_s"] == pytest.approx(RIG.camera.frame_delay_s + later_s, abs=0.003)


def with_settings(*settings):
    return site_of(load_rig(default_rig_path(), settings))


def controller(name):
    return f"loops.right.vernier.controller={name}"


@pytest.mark.long
def test_a_design_without_margins_gives_way_to_the_best_that_has_them():
    outcome = check_design(with_settings(controller("eq20")))
    chosen = outcome.found["loops"]["right"]["vernier"]["controller"]
    assert chosen == "minimum-variance"  # fslq leaves as little, with more states
    assert outcome.figures[f"{chosen} phase_margin_deg"] >= 35
    assert outcome.figures["eq20 phase_margin_deg"] < 35
    assert outcome.state == "measured"


@pytest.mark.long
def test_a_design_with_margins_that_leaves_as_little_is_kept():
    outcome = check_design(with_settings(controller("minimum-variance")))
    assert outcome.state == "passed"
    assert "minimum-variance, the rig file's controller, stays" in outcome.lines


@pytest.mark.long
def test_without_a_design_that_keeps_its_margins_the_step_fails(monkeypatch):
    monkeypatch.setattr(identified, "Required", lambda: Required(gain_margin_db=60.0))
    with pytest.raises(StepError, match=r"no design keeps all margins .*gain 60 dB"):
        check_design(with_settings(controller("minimum-variance")))


def test_what_an_identification_moves_is_printed_before():
    assert identification_moves("hysteresis")(site_of()).endswith(
        "stack1 by 5 V, stack2 by 5 V, stack3 by 5 V"
    )
    assert identification_moves("airpath")(site_of()).endswith("nothing")
