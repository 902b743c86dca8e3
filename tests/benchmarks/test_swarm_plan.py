"""What the draw of a plan has: rigs, settings, happenings."""

from itertools import pairwise
from random import Random
from typing import get_args

import pytest

from benchmarks.swarm.commands import LEARNT_DESIGNS
from benchmarks.swarm.happenings import RESTARTS, Happening, Order, Strike, kind_of
from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.lines import FAULTS, OF_SOME_CALLS, WRONG
from benchmarks.swarm.plan import DURATION_S, drawn_plan
from benchmarks.swarm.rigs import (
    PHOTON_NOISE,
    RIGS,
    SETTINGS,
    SLOW,
    devices_of,
    drawn_gusts,
    gusty,
    learning,
    moving,
    several_writes,
    slow_servos,
    vibrating,
    vibration,
    with_another_spot,
)
from fitctl.config import ConfigError, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.messages.commands import (
    AnyCommand,
    Experiment,
    RecorderReport,
    Release,
    SequenceReport,
)

VIBRATION = vibration(20.0, 0.3, 180.0)
LINK = {"metrology photodiodes", "metrology siderostat"}
KINDS = {kind_of(device) for device in devices_of("fit-testbed.toml")}


@pytest.mark.parametrize("rig", RIGS)
def test_every_setting_is_one_that_the_rig_can_have(rig):
    load_rig(FOLDER / rig, list(SETTINGS))
    for which in range(2) if rig in SLOW else ():
        load_rig(FOLDER / rig, [*SETTINGS, *slow_servos(rig, which)])
    for told in (False, True):
        skies = [
            *vibrating(rig, VIBRATION),
            *gusty(rig, drawn_gusts(Random(1), DURATION_S), VIBRATION),
            *moving(rig, 0.3, -0.3, told=told),
            *with_another_spot(rig, told=told),
        ]
        settings = [*SETTINGS, *several_writes(rig), *learning(rig), PHOTON_NOISE, *skies]
        load_rig(FOLDER / rig, settings)


def test_a_setting_of_the_sky_is_true_of_each_star_and_known_if_it_is_told():
    rig = "two-stars.toml"
    loaded = [load_rig(FOLDER / rig, moving(rig, 0.2, -0.1, told=told)) for told in (False, True)]

    for each in loaded:
        rates = [star.star_rate_sky_arcsec_s for star in each.plant.stellar_loops.values()]
        assert [(rate.az, rate.el) for rate in rates] == [(0.2, -0.1)] * 2
    known = [
        [loop.star_rate_sky_arcsec_s for loop in each.stellar_loops.values()] for each in loaded
    ]
    assert known[0] == [None, None]
    assert [(rate.az, rate.el) for rate in known[1]] == [(0.2, -0.1)] * 2


@pytest.mark.long
def test_after_each_gust_the_stars_vibrate_as_before_and_all_are_over_when_the_healing_begins():
    rig = "two-stars.toml"
    for seed in range(50):
        gusts = drawn_gusts(Random(seed), DURATION_S)
        plant = load_rig(
            FOLDER / rig, [*vibrating(rig, VIBRATION), *gusty(rig, gusts, VIBRATION)]
        ).plant

        for loop in ("right", "left"):
            changes = plant.changes(loop)
            before = plant.stellar_loops[loop].lines
            assert [change.lines == before for _, change in changes] == [False, True] * len(gusts)
            assert changes[-1][0] < DURATION_S


def test_restarts_take_no_time_or_some_in_which_the_device_does_not_answer():
    takes = set()
    for seed in range(50):
        happenings = drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
        struck = [happening for happening in happenings if isinstance(happening, Strike)]
        for restart in struck:
            if restart.fault in RESTARTS:
                others = [other for other in struck if other.at_s == restart.at_s]
                booting = {other.fault for other in others if other.device == restart.device}
                takes |= booting - {restart.fault} or {""}
    assert takes >= {"", "unplugged", "deaf"}


def test_plans_have_every_kind_of_happening():
    happenings = [
        happening
        for seed in range(250)
        for happening in drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
    ]

    assert {type(happening) for happening in happenings} == set(get_args(Happening))
    of_lines = {(device, fault) for device in KINDS for fault in (*FAULTS, "reset")}
    wrong = {(device, fault) for device, faults in WRONG.items() for fault in faults}
    struck = {
        (kind_of(happening.device), happening.fault)
        for happening in happenings
        if isinstance(happening, Strike)
    }
    assert struck == of_lines | wrong | {("siderostat", "power cut")}
    kinds = {happening.kind for happening in happenings}
    of_devices = {kind.partition(" ")[2] for kind in kinds}
    for fault in set(FAULTS) & set(OF_SOME_CALLS):
        assert of_devices >= {fault, f"{fault} at times", f"{fault} once"}
    assert "stall of the supervisor" in kinds


def test_in_most_plans_of_the_testbed_its_loops_have_time_to_hold_their_stars():
    """Between what happens there are at least 10 s, in more than half of the time."""
    times = []
    for seed in range(100):
        happenings = drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
        met_s = [each.at_s for each in happenings if each.kind not in {"onwards", "LearnerReport"}]
        pauses_s = [after - before for before, after in pairwise([0.0, *met_s, DURATION_S])]
        times.append(sum(pause_s for pause_s in pauses_s if pause_s >= 10.0))

    assert 40 < sum(time_s > DURATION_S / 2 for time_s in times) < 80


def test_many_experiments_meet_the_loop_that_waits_for_its_link():
    met = 0
    for seed in range(50):
        happenings = drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
        away_s = [
            happening.at_s
            for happening in happenings
            if (isinstance(happening, Order) and happening.command == Release(loop="metrology"))
            or (isinstance(happening, Strike) and happening.device in LINK)
        ]
        met += sum(
            isinstance(happening, Order)
            and isinstance(happening.command, Experiment)
            and happening.command.loop == "left"
            and any(0.0 < happening.at_s - at_s < 8.0 for at_s in away_s)
            for happening in happenings
        )

    assert met > 50


def test_plans_have_every_command_that_people_and_the_learner_give():
    commands = {
        type(happening.command)
        for seed in range(100)
        for happening in drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
        if isinstance(happening, Order) and happening.command is not None
    }

    # The recorder and running sequences send their reports themselves.
    assert commands == set(get_args(AnyCommand)) - {RecorderReport, SequenceReport}


@pytest.mark.long
def test_of_the_learnt_designs_the_last_has_not_the_margins():
    rig = load_rig(FOLDER / "fit-mock.toml")
    *made, refused = LEARNT_DESIGNS

    assert all(design_for(rig, "right", text).learnt for text in made)
    with pytest.raises(ConfigError, match="margins"):
        design_for(rig, "right", refused)


def test_plans_have_every_sky_and_learners():
    settings = " ".join(
        text
        for seed in range(100)
        for text in drawn_plan(Random(seed), seed, "fit-mock.toml").settings
    )

    for key in (
        "camera.electrons_per_dn",
        "plant.loops.right.lines",
        "plant.loops.right.star_rate_sky_arcsec_s",
        " loops.right.star_rate_sky_arcsec_s",
        "plant.loops.right.spots",
        " loops.right.other_spots",
        ' loops.right.learn="on"',
    ):
        assert key in f" {settings}"


def test_photodiodes_come_loose_for_longer_than_a_beam_out_of_reach_is_held():
    loose = [
        happening
        for seed in range(20)
        for happening in drawn_plan(Random(seed), seed, "fit-testbed.toml").happenings
        if isinstance(happening, Strike) and happening.fault == "loose" and happening.lasts_s > 0.2
    ]

    assert len(loose) > 5
    assert {strike.device for strike in loose} == {"metrology photodiodes"}
    assert {strike.size for strike in loose} == {0.0, 1.0, 2.0, 3.0}
