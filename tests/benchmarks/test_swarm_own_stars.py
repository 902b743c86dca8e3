"""What the swarm requires of the star that a loop follows."""

import numpy as np
import pytest

from fitctl.messages.commands import Look, Reply
from tests.samples.log_samples import tick


def follow(invariants, plant, seconds, away_px, mode="VERNIER"):
    for at_s in 5.0 + 0.5 * np.arange(2 * seconds):
        az_px, el_px = plant.spots_px(at_s)[0, 0] + (0.6 * away_px, 0.8 * away_px)
        row = {"mid_exposure_s": at_s, "star_az_px": az_px, "star_el_px": el_px}
        invariants.record(tick(1, loop="right", mode=mode, frame_age_s=0.02, **row))
    return [one.invariant for one in invariants.violations]


@pytest.mark.parametrize("mode", ["COARSE", "VERNIER"])
def test_a_loop_that_follows_anothers_star_is_noticed(invariants, plant, mode):
    assert follow(invariants, plant, 12, 7.0, mode) == ["a loop follows its own star"]


@pytest.mark.parametrize(
    ("seconds", "away_px", "mode"),
    [(12, 5.0, "VERNIER"), (9, 7.0, "VERNIER"), (12, 7.0, "ACQUISITION"), (12, np.nan, "VERNIER")],
)
def test_a_loop_may_see_its_own_star_or_another_for_a_while(
    invariants, plant, seconds, away_px, mode
):
    assert follow(invariants, plant, seconds, away_px, mode) == []


def test_a_loop_may_follow_what_a_frozen_camera_shows(invariants, plant):
    invariants._lines["camera"].wrong["frozen"] = 0.0

    assert follow(invariants, plant, 12, 7.0) == []


def test_a_loop_may_follow_a_star_that_a_person_pointed_at(invariants, plant):
    invariants.answered(Look(az_px=20.0, el_px=20.0), Reply(accepted=True))

    assert follow(invariants, plant, 12, 7.0) == []
