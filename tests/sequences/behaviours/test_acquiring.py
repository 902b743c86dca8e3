"""`acquire` without a loop: all loops search at once, and only one that finds nothing searches again."""

import pytest
from sequence_runs import lose

from fitctl.messages.commands import Acquire

pytestmark = pytest.mark.long

# No star is so bright. One loop has searched all its field long before the other.
NO_STAR = {"step": "acquire", "star_flux_dn": 100_000.0}
RADII = (
    "loops.right.acquisition.search_radius_sky_arcsec=60.0",
    "loops.left.acquisition.search_radius_sky_arcsec=215.0",
)


@pytest.fixture
def run(tried):
    return tried(*RADII, rig="two-stars.toml")


def modes(run):
    return {loop.name: loop.mode for loop in run.link.receive(1.0).loops}


def test_a_step_that_fails_ends_the_searches_of_all_loops(run):
    run({"step": "standby"}, {**NO_STAR, "attempts": 1})

    assert run.attempts[-1].loop == "right"
    assert run.attempts[-1].outcome == "failed"
    assert modes(run) == {"right": "STANDBY", "left": "STANDBY"}
    assert run.link.now_s() < 3.0  # long before the other search is exhausted


def test_only_the_loop_that_found_nothing_searches_again(run):
    looks = []
    # The second attempt of the one loop has begun, the first of the other goes on.
    run.link.meddling = [(3.0, lambda _: looks.append(modes(run)))]

    run({"step": "standby"}, {**NO_STAR, "attempts": 2})

    assert run.outcomes()[-2:] == ["failed", "failed"]
    asked = [command.loop for command in run.link.commands if isinstance(command, Acquire)]
    assert asked == ["", "right"]
    assert looks == [{"right": "ACQUISITION", "left": "ACQUISITION"}]


def test_a_lost_answer_ends_the_searches_of_all_loops_at_once(run):
    run.link.meddling = [(1.0, lambda link: lose(link, lambda _: True))]

    with pytest.raises(ConnectionError):
        run({"step": "standby"}, {**NO_STAR, "attempts": 2})

    assert modes(run) == {"right": "STANDBY", "left": "STANDBY"}
