"""Rounds of the search for a star that was lost: each waits at its last place, then searches wider."""

from __future__ import annotations

from fitctl.model.compiled import compilable

WIDEST_ROUND = 2  # the first is round 0; from this one on, radius and pause are the rig's own


@compilable()
def round_fraction(number: int) -> float:
    """Part of the rig's radius and pause in a round: a quarter in round 0, then a half, then the whole."""
    return float(2.0 ** (min(number, WIDEST_ROUND) - WIDEST_ROUND))
