"""A night as designs count with it: its air, noise and lines, and how far the mirror moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from fitctl.config import ConfigError
from fitctl.controllers.design.basis import LEAST_GAIN, MOST_OVERSHOOT, Basis
from fitctl.learn.aliases import SIDES, alias_of, at_frequency, can_be_alias
from fitctl.learn.frame_rates import AtOtherRate, Classified, classified_before, classify
from fitctl.learn.intervals import Interval
from fitctl.learn.night import LearntLine, Night, estimate, estimate_with_aliases
from fitctl.learn.opened import LEAST_S, Opened, Series, periodograms

TOLERATED = (0.85, 1.15)
"""A design does not compensate for a mirror's gain between these: its margins cover the deviation."""


def estimated(
    series: list[Series],
    rig_basis: Basis,
    known: Sequence[Classified] = (),
    others: Sequence[AtOtherRate] = (),
) -> tuple[Night, Basis, list[Classified]]:
    """Estimate a night, what designs count with if that is what it was like, and which lines are aliases.

    Arguments as of :func:`fitctl.learn.advice.advise`.

    Raises
    ------
    ConfigError
        If there is too little of it, no air path explains it, or the mirror hardly moves.
    """
    opened = periodograms(series, rig_basis.period_s)
    if opened is None:
        longest_s, rate_hz = _longest_s(series, rig_basis.period_s), 1 / rig_basis.period_s
        other_hz = {
            1 / at.period_s for at in others if _longest_s(at.series, at.period_s) >= LEAST_S
        }
        instead = "give a longer log"
        if other_hz:
            rates = " and ".join(f"{hz:.4g}" for hz in sorted(other_hz))
            instead = f"there is more at {rates} Hz: give that as --set camera.frame_rate_hz"
        msg = (
            f"learn: the longest piece in VERNIER at {rate_hz:.4g} Hz is {longest_s:.0f} s, from where it has "
            f"settled; expected at least {LEAST_S:.0f} s, preferably two minutes, with a star held on its "
            f"target; {instead}"
        )
        raise ConfigError(msg)
    night = estimate(opened, rig_basis.air_path, rig_basis.noise_px)
    suspects = _suspects(night, rig_basis)
    classified = classify(opened, night, suspects, known, others)
    if any(one.is_alias for one in classified):
        night = estimate_with_aliases(opened, night, _at_hz(night, classified))
        classified = classified_before(_suspects(night, rig_basis), opened.period_s, classified)
    slow_hz = tuple(one.frequency_hz for one in classified if not one.is_alias)
    rig_basis = dataclasses.replace(rig_basis, slow_lines_hz=slow_hz)
    at_hz = _at_hz(night, classified)
    truth = dataclasses.replace(
        rig_basis,
        noise_px=night.noise_px.value,
        air_path=night.air_path,
        lines=tuple(at_frequency(line.for_design, hz) for line, hz in at_hz.items()),
        mirror_gain=_gain_for_design(opened, night, at_hz, rig_basis),
        overshoot=_overshoot_for_design(night),
    )
    return night, truth, classified


def _longest_s(series: Sequence[Series], period_s: float) -> float:
    return max((len(one.disturbance_px) for one in series), default=0) * period_s


def _at_hz(night: Night, classified: Sequence[Classified]) -> dict[LearntLine, float]:
    """Where the lines of a night are, as far as it is known."""
    true_hz = dict(classified)
    return {line: true_hz.get(hz := line.frequency_hz.value, hz) for line in night.lines}


def _suspects(night: Night, rig_basis: Basis) -> list[LearntLine]:
    """The lines that can be aliases."""
    return [line for line in night.lines if can_be_alias(line.for_design, rig_basis)]


def _gain_for_design(
    opened: Opened, night: Night, at_hz: Mapping[LearntLine, float], rig_basis: Basis
) -> float:
    """Of the mirror: the rig file's, unless the night says otherwise beyond what the margins cover.

    Within them the estimate is not worth its risk. Where lines can be aliases, the night must say so with each
    of them, too: an alias has other tails than the slow line that it looks like, and the gain makes up for
    them, by 30 % on some nights.

    Raises
    ------
    ConfigError
        If the mirror moves so little or so much that something is wrong with it.
    """
    found = night.mirror_gain
    if _is_tolerated(found):
        return 1.0
    suspects = _suspects(night, rig_basis)
    for side in SIDES if suspects else ():
        aliases_hz = {
            line: alias_of(line.for_design, rig_basis, side).frequency_hz for line in suspects
        }
        if _is_tolerated(estimate_with_aliases(opened, night, {**at_hz, **aliases_hz}).mirror_gain):
            return 1.0
    if not LEAST_GAIN <= found.value <= 1 / LEAST_GAIN:
        msg = (
            f"learn: the mirror moves by {found} of what the rig file predicts; expected {LEAST_GAIN:g} to "
            f"{1 / LEAST_GAIN:g}; look at its amplifiers and measure it with fitctl identify hysteresis; if "
            "vernier.air_path is far from the night's air, measure that with fitctl identify airpath"
        )
        raise ConfigError(msg)
    return found.value


def _is_tolerated(gain: Interval) -> bool:
    less, more = TOLERATED
    return gain.low < more and gain.high > less


def shown_gain(night: Night) -> float:
    """Of the mirror, where less motion speaks against a design: the estimate, if it is known to be below 1."""
    found = night.mirror_gain
    return found.value if found.high < 1 else 1.0


def gain_for_aliases(night: Night) -> float:
    """Of the mirror, where too much of it hides harm: the estimate, even if its interval includes 1.

    It counts at its least if that is less than the margins cover: after a minute of a night with 30 % of
    hysteresis it was 0.94, at least 0.71, and later 0.6. A learnt design then left 14 % more of an alias.
    """
    found = night.mirror_gain
    return min(1.0, found.value if found.low >= TOLERATED[0] else found.low)


def _overshoot_for_design(night: Night) -> float:
    """Of the mirror, where it is known to differ from 0; a large one means that the delay is wrong."""
    found = night.overshoot
    if found.covers(0.0) or abs(found.value) > MOST_OVERSHOOT:
        return 0.0
    return found.value
