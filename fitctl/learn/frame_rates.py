"""Vibrations distinguished from their aliases by a short change of the frame rate.

On frames of one rate, a vibration looks like those that are faster by a multiple of the rate, or as far below
one. At another rate a slow line stays where it was, and its aliases move, each elsewhere. So at the other rate
the line is at one of a few frequencies, and the likelihoods show at which, and how surely.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.linear_loop.spectrum import seen_at_hz
from fitctl.learn.night import LEAST_LINE_HZ, LearntLine, Night, guess_of
from fitctl.learn.opened import Opened, Series, periodograms
from fitctl.learn.whittle import LineGuess, Near, likeliest
from fitctl.loop.frame_rate import OTHER_RATE, frames_watched

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]
OTHER_RATES = (0.96, 0.95, 0.97, 0.94)
"""Of the rig's frame rate: a change to one of these, which keeps lines and possible aliases farthest apart."""
_LEAST_S = 8.0  # at another rate: lines that are worth it show within a few seconds
# Multiples of the frame rate beside which aliases are looked for, and beside which one that would look the same
# keeps a line from being called slow. Exposures of some milliseconds leave little of what is faster.
_MULTIPLES, _MORE_MULTIPLES = 2, 5
SAME_LINE_HZ = 0.3
"""A line is the one that was classified before if it is no farther from it: some drift."""
WORTH_CLASSIFYING = 0.9
"""A design that knows which lines are aliases must leave at most this part, or another rate is not worth it."""
_ROUNDS = 3
_NEAR = Near(away_hz=0.2, broader=3.0)
"""So near a line must be to where it is expected,"""
_INSIDE = 0.99  # of that way
_WEAKER = 0.4
"""and so much of its RMS it must have: beyond that it explains something else. A narrow line has less for a
seventh of the time, and is not classified then."""
_HIDDEN_HZ = 0.5
"""Below this, air looks like a line."""
_SURE = 6.0
"""By how much the logarithm of the likelihood must be higher in one case: it is 400 times as likely."""
_SURE_OF_TWO = 10.0
"""The same with one line more: its four numbers make it higher by one each if there is no such line."""


class Classified(NamedTuple):
    """Where a line looks to be on frames, and where it is, as another frame rate has shown."""

    frequency_hz: float
    true_hz: float

    @property
    def is_alias(self) -> bool:
        """It is faster than it looks."""
        return self.true_hz != self.frequency_hz


class AtOtherRate(NamedTuple):
    """A loop, opened, while the camera ran at another rate."""

    period_s: float
    series: list[Series]


def by_rate(
    exposed_s: Floats, pieces: Iterable[Rows], period_s: float
) -> tuple[list[Rows], list[tuple[float, Rows]]]:
    """Pieces at the rig's frame rate, and those at others, each with its frame period in s.

    Parameters
    ----------
    exposed_s : array, shape (ticks,)
        Of mid-exposure.
    pieces : iterable of array of int
        Rows of ticks, none of which lacks many frames.
    period_s : float
        By the rig file.
    """
    usual: list[Rows] = []
    others: list[tuple[float, Rows]] = []
    half = frames_watched(period_s) // 2
    for rows in pieces:
        at_s = exposed_s[rows]
        due = np.append(0.0, np.cumsum(np.maximum(1.0, np.rint(np.diff(at_s) / period_s))))
        first = np.maximum(0, np.arange(len(rows)) - half)
        last = np.minimum(len(rows) - 1, np.arange(len(rows)) + half)
        apart = np.maximum(1.0, due[last] - due[first])
        periods = (at_s[last] - at_s[first]) / apart
        is_other = (np.abs(periods / period_s - 1) > OTHER_RATE) & (apart >= half)
        for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(is_other)) + 1):
            if is_other[run[0]]:
                others.append((float(np.median(periods[run])), rows[run]))
            elif len(run) > 1:
                usual.append(rows[run])
    return usual, others


def joined(pieces: Sequence[Rows]) -> Rows:
    """The rows of all pieces."""
    return np.concatenate([np.empty(0, np.intp), *pieces])


def classifying_rate(frequencies_hz: Sequence[float], rate_hz: float) -> float:
    """The frame rate, Hz, at which these lines and their aliases are farthest from each other.

    And from 0, where lines and air look alike.
    """

    def nearest_hz(rate: float) -> float:
        places = [_places_hz(hz, rate_hz, rate * rate_hz, _MORE_MULTIPLES) for hz in frequencies_hz]
        aliases = [hz for slow, *others in places for hz in others if hz != slow]
        return min(abs(hz - away) for hz in aliases for away in (0.0, *(one[0] for one in places)))

    return rate_hz * max(OTHER_RATES, key=nearest_hz)


def classified_before(
    lines: Sequence[LearntLine], period_s: float, known: Sequence[Classified]
) -> list[Classified]:
    """The lines that were classified before, where they are now: they may have drifted since."""
    same = []
    for line in lines:
        hz = line.frequency_hz.value
        near = [one for one in known if abs(one.frequency_hz - hz) <= SAME_LINE_HZ]
        if near:
            was_hz = min(near, key=lambda one: abs(one.frequency_hz - hz)).true_hz
            is_hz = min(_true_hz(hz, 1 / period_s), key=lambda may: abs(may - was_hz))
            same.append(Classified(hz, is_hz))
    return same


def classify(
    opened: Opened,
    night: Night,
    lines: Sequence[LearntLine],
    known: Sequence[Classified],
    others: Iterable[AtOtherRate],
) -> list[Classified]:
    """What is known of a night's lines, and what other frame rates show of them.

    Parameters
    ----------
    opened : Opened
        At the rig's frame rate,
    night : Night
        what was estimated from it,
    lines : sequence of LearntLine
        with those of its lines that may be aliases.
    known : sequence of Classified
        Before.
    others : iterable of AtOtherRate
        What these show counts more than what was known before. Looked at while some line is not known.
    """
    true_hz = dict(classified_before(lines, opened.period_s, known))
    for line in lines:
        hz = line.frequency_hz.value
        if hz != true_hz.get(hz, hz) and _looks_otherwise(opened, night, line, true_hz[hz]):
            del true_hz[hz]
    if len(true_hz) < len(lines):
        made = (periodograms(other.series, other.period_s, _LEAST_S) for other in others)
        enough = [one for one in made if one is not None]
        if enough:
            true_hz |= _shown(opened, night, lines, enough)
    found_hz = [line.frequency_hz.value for line in lines]
    return [Classified(hz, true_hz[hz]) for hz in found_hz if hz in true_hz]


def _looks_otherwise(opened: Opened, night: Night, line: LearntLine, at_hz: float) -> bool:
    """Whether frames at the usual rate show surely that a line is not this alias, but slow."""
    slow_hz = {one: one.frequency_hz.value for one in night.lines}
    as_slow, as_alias = (
        likeliest(opened, guess_of(night, places.items())).cost
        for places in (slow_hz, slow_hz | {line: at_hz})
    )
    return as_alias - as_slow >= _SURE


def _shown(
    opened: Opened,
    night: Night,
    lines: Sequence[LearntLine],
    others: Sequence[Opened],
) -> dict[float, float]:
    """The lines of which all frames show surely whether they are aliases: where they look to be and are, Hz."""
    rate_hz = 1 / opened.period_s
    places_hz = {line: _true_hz(line.frequency_hz.value, rate_hz) for line in lines}
    unsuspected_hz = {
        line: line.frequency_hz.value for line in night.lines if line not in places_hz
    }

    def at_hz(places: Sequence[float]) -> dict[LearntLine, float]:
        return dict(zip(places_hz, places, strict=True)) | unsuspected_hz

    @functools.cache
    def fits(*places: float) -> list[_Fit]:
        return [_fit(night, at_hz(places).items(), other) for other in others]

    def cost(*places: float) -> float:
        return sum(fit.cost for fit in fits(*places))

    def with_one(at: int, places: Sequence[float]) -> list[tuple[float, ...]]:
        """One line at each of its places, and the others where they are."""
        return [(*places[:at], hz, *places[at + 1 :]) for hz in places_hz[lines[at]]]

    def improved(places: list[float]) -> list[float]:
        """One line after the other where it is likeliest: where it is counts for what others explain."""
        for _ in range(_ROUNDS):
            before = list(places)
            for at, line in enumerate(lines):
                each = [cost(*one) for one in with_one(at, places)]
                places[at] = places_hz[line][int(np.argmin(each))]
            if places == before:
                break
        return places

    begins = zip(*places_hz.values(), strict=True)  # none is an alias, or all of one kind
    best_hz = min((improved(list(begin)) for begin in begins), key=lambda end: cost(*end))
    shown = {}
    for at, line in enumerate(lines):
        # Frames at the usual rate show the tails of an alias otherwise than those of a slow line.
        each = [
            cost(*one) + likeliest(opened, guess_of(night, at_hz(one).items())).cost
            for one in with_one(at, best_hz)
        ]
        best = int(np.argmin(each))
        true_hz = places_hz[line][best]
        # Which alias it is may stay open where all rates show them alike: the design leaves each alone.
        differ = [
            place
            for place, hz in enumerate(places_hz[line])
            if hz != true_hz and (0 in (place, best) or not _look_alike(hz, true_hz, others))
        ]
        otherwise = min(differ, key=each.__getitem__)
        else_hz = places_hz[line][otherwise if best == 0 else 0]
        looks_slow = true_hz == line.frequency_hz.value and _looks_slow(true_hz, rate_hz, others)
        hidden = all(seen_at_hz(true_hz, 1 / other.period_s) < _HIDDEN_HZ for other in others)
        there = with_one(at, best_hz)[best]
        is_found = any(line in fit.found for fit in fits(*there))
        if each[otherwise] - each[best] < _SURE or looks_slow or hidden or not is_found:
            continue
        both = [*at_hz(there).items(), (line, else_hz)]
        # If it is seen at both places, two vibrations look the same at the usual rate.
        if cost(*there) - sum(_fit(night, both, other).cost for other in others) < _SURE_OF_TWO:
            shown[line.frequency_hz.value] = true_hz
    return shown


def _look_alike(one_hz: float, two_hz: float, others: Sequence[Opened]) -> bool:
    """Whether all these rates show two vibrations at the same place."""
    rates_hz = [1 / other.period_s for other in others]
    return all(
        abs(seen_at_hz(one_hz, rate) - seen_at_hz(two_hz, rate)) <= SAME_LINE_HZ
        for rate in rates_hz
    )


def _looks_slow(line_hz: float, rate_hz: float, others: Sequence[Opened]) -> bool:
    """Whether a line faster than those that are looked for would look like this slow one at all other rates."""
    faster = _true_hz(line_hz, rate_hz, _MORE_MULTIPLES)[len(_true_hz(line_hz, rate_hz)) :]
    return any(_look_alike(hz, line_hz, others) for hz in faster)


def _places_hz(line_hz: float, rate_hz: float, other_hz: float, multiples: int) -> list[float]:
    """Where a line that is seen at `line_hz` may be seen at another rate: first if it is no alias."""
    true_hz = _true_hz(line_hz, rate_hz, multiples)
    return [max(LEAST_LINE_HZ, seen_at_hz(hz, other_hz)) for hz in true_hz]


def _true_hz(line_hz: float, rate_hz: float, multiples: int = _MULTIPLES) -> list[float]:
    """Where a line may be that is seen at `line_hz`: first if it is no alias.

    Beside half the frame rate, a line and its slowest alias are the same vibration.
    """
    aliases_hz = (
        multiple * rate_hz + side * line_hz
        for multiple in range(1, multiples + 1)
        for side in (-1, 1)
    )
    return [
        line_hz,
        *(line_hz if abs(hz - line_hz) <= SAME_LINE_HZ else hz for hz in aliases_hz),
    ]


class _Fit(NamedTuple):
    """What another rate shows with lines at certain places.

    Attributes
    ----------
    cost : float
        Negative logarithm of the likelihood.
    found : frozenset of LearntLine
        The lines that are where they are expected.
    """

    cost: float
    found: frozenset[LearntLine]


def _fit(night: Night, places_hz: Iterable[tuple[LearntLine, float]], opened: Opened) -> _Fit:
    """The likeliest spectrum with the lines at these places, and without those that are too weak there."""
    rate_hz = 1 / opened.period_s
    seen_hz = [(line, max(LEAST_LINE_HZ, seen_at_hz(hz, rate_hz))) for line, hz in places_hz]
    begin = guess_of(night, seen_hz)
    # A mirror that may move otherwise than it did explains away a line that is not where it should be.
    end = likeliest(opened, begin, free_mirror=False, near=_NEAR)
    strong = [
        (line, expected, found)
        for (line, _), expected, found in zip(seen_hz, begin.lines, end.guess.lines, strict=True)
        if _is_strong(expected, found)
    ]
    if len(strong) < len(begin.lines):
        stayed = tuple(expected for _, expected, _ in strong)
        end = likeliest(opened, begin._replace(lines=stayed), free_mirror=False, near=_NEAR)
    there = (line for line, expected, found in strong if _is_inside(expected, found))
    return _Fit(end.cost, frozenset(there))


def _is_strong(line: LineGuess, found: LineGuess) -> bool:
    """Whether what a search has found is strong enough for the line with which it began."""
    return float(np.max(found.rms_px)) >= _WEAKER * float(np.max(line.rms_px))


def _is_inside(line: LineGuess, found: LineGuess) -> bool:
    """Whether it would not go farther: what stops at the limit explains something else."""
    return abs(found.frequency_hz - line.frequency_hz) < _INSIDE * _NEAR.away_hz
