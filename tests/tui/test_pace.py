"""The console's share of a core, whatever a drawing costs."""

import pytest

from fitctl.tui.pace import LONGEST_S, SHARE, Pace

BEAT_S = 0.1


class Machine:
    now_s = used_s = 0.0


def drawn(cost_s, beats, reading_s=0.0):
    """How many of some beats are drawn, if each drawing costs so much, and reading meanwhile so much a beat."""
    machine = Machine()
    pace = Pace(lambda: machine.now_s, lambda: machine.used_s)
    count = 0
    for _ in range(beats):
        machine.now_s += BEAT_S
        machine.used_s += reading_s
        if pace.due():
            count += 1
            machine.used_s += cost_s
    return count


def test_what_is_cheap_is_drawn_at_every_beat():
    assert drawn(0.9 * SHARE * BEAT_S, 200) == 200


@pytest.mark.parametrize("cost_s", [0.02, 0.03, 0.05, 0.08])
def test_what_is_dear_is_drawn_less_often_and_stays_within_its_share(cost_s):
    count = drawn(cost_s, 1000)
    assert count * cost_s / (1000 * BEAT_S) <= SHARE * 1.02
    assert count * cost_s / (1000 * BEAT_S) >= SHARE * 0.6


def test_however_dear_it_is_something_is_drawn_about_once_in_the_longest_time():
    assert drawn(10.0, 1000) >= 1000 * BEAT_S / (LONGEST_S + 2 * BEAT_S)


@pytest.mark.parametrize("part", [1.0, 1.5, 8.0])
def test_something_is_drawn_where_reading_alone_takes_the_share(part):
    assert drawn(0.01, 1000, part * SHARE * BEAT_S) >= 1000 * BEAT_S / (LONGEST_S + 2 * BEAT_S)
