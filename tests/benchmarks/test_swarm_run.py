"""Runs of the swarm without a defect."""

import itertools
from random import Random

import pytest
from samples.learner_reports import report

from benchmarks.swarm import plan as plans
from benchmarks.swarm.commands import LEARNT_DESIGNS
from benchmarks.swarm.happenings import Kill, Strike
from benchmarks.swarm.rigs import RIGS, SLOW, learning, slow_servos
from benchmarks.swarm.run import run_plan
from fitctl.logging.records import ControllerChange
from fitctl.messages.commands import MoveCollector, Standby
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.siderostat import SiderostatStage
from tests.benchmarks.plans import gives, plan


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "settings"),
    [*((rig, []) for rig in RIGS), *((rig, slow_servos(rig, 1)) for rig in SLOW)],
)
def test_each_rig_holds_its_stars_where_nothing_happens(rig, settings):
    quiet = plan(gives(0.1, None), gives(6.0, None), duration_s=7.0, rig=rig, settings=settings)
    result = run_plan(quiet)

    assert result.violations == []
    assert result.modes["VERNIER"] >= 1


@pytest.mark.long
def test_a_learnt_design_comes_by_itself_while_the_star_is_held():
    learnt = report(design_json=LEARNT_DESIGNS[0])
    learner = [gives(float(at_s), learnt) for at_s in range(2, 40, 4)]
    changes = []

    def keep(record):
        if isinstance(record, ControllerChange):
            changes.append(record)

    watched = plan(
        gives(0.1, None),
        gives(1.0, None),
        *learner,
        duration_s=42.0,
        settings=learning("fit-mock.toml"),
    )
    assert run_plan(watched, keep).violations == []
    assert [change.target for change in changes][:1] == ["learnt"]
    assert "learnt from" in changes[0].reason


@pytest.mark.long
def test_nothing_begins_once_all_is_being_healed():
    late = Strike(at_s=36.0, device="camera", fault="mute", lasts_s=60.0)

    assert run_plan(plan(late, duration_s=8.0)).violations == []


@pytest.mark.long
def test_the_testbed_goes_back_to_its_stars_though_two_supervisors_are_killed_before_a_search():
    result = run_plan(
        plan(
            *[gives(at_s, None) for at_s in (0.1, 1.5, 3.0, 5.0, 8.0)],
            Kill(at_s=26.0, back_after_s=0.5),
            gives(28.0, Standby()),
            Kill(at_s=32.0, back_after_s=0.5),
            duration_s=34.0,
            rig="fit-testbed.toml",
        )
    )

    assert result.violations == []
    assert result.modes["VERNIER"] >= 2


@pytest.mark.long
def test_the_testbed_finds_its_star_though_the_collector_went_far_without_a_held_beam():
    result = run_plan(
        plan(
            gives(0.5, MoveCollector(action="reference")),
            gives(8.0, MoveCollector(action="start", kind="drift", velocity_mm_s=1.0)),
            duration_s=24.0,
            rig="fit-testbed.toml",
        )
    )

    assert result.violations == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("part", "violated"), [(1.0, []), (1.05, ["no siderostat is driven beyond its travel"])]
)
def test_a_siderostat_that_is_jogged_to_the_end_stays_within_its_travel(
    monkeypatch, part, violated
):
    made = SiderostatStage.__init__

    def made_with_travel(self, *arguments):
        made(self, *arguments)
        self.travel_rad *= part

    monkeypatch.setattr(SiderostatStage, "__init__", made_with_travel)
    jogs = plans._jogged_to_the_end(Random(1), 12.0, ("right",))
    result = run_plan(plan(*[gives(at_s, None) for at_s in (0.1, 1.0)], *jogs, duration_s=20.0))

    assert [one.invariant for one in result.violations] == violated


@pytest.mark.long
@pytest.mark.parametrize("jump_urad", [0.0, 3.0])
def test_a_mirror_that_jumps_to_and_fro_while_a_star_is_held_is_a_violation(monkeypatch, jump_urad):
    move_to, jumps_rad = MirrorStage.move_to, itertools.cycle([jump_urad * 1e-6, -jump_urad * 1e-6])

    def jump(self, mirror_rad, **options):
        move_to(self, mirror_rad + next(jumps_rad), **options)

    monkeypatch.setattr(MirrorStage, "move_to", jump)
    violated = {one.invariant for one in run_plan(plan(gives(0.1, Standby()))).violations}

    assert violated == ({"a star that is held stays so"} if jump_urad else set())
