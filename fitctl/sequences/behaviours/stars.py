"""The step that goes through a list of stars: what it does with each, and what came of all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec

from fitctl.config import Rig
from fitctl.logging.records import SequenceAttempt
from fitctl.sequences import steps
from fitctl.sequences.behaviours.acquiring import ACQUIRE
from fitctl.sequences.behaviours.behaviour import Behaviour, Result
from fitctl.sequences.view import StepFailed, View


class StarResult(NamedTuple):
    """What came of one star; `why_not` is empty where it was held well."""

    name: str
    figures: dict[str, float | None]
    why_not: str


def steps_of(step: steps.Stars, star: steps.Star, moved_s: float = 0.0) -> list[steps.Step]:
    """What is done with one star, which has moved for so long from its place in the list."""
    limits: dict[str, Any] = {"loop": step.loop, "timeout_s": step.timeout_s}
    return [
        steps.Acquire(
            expected_az_sky_arcsec=star.az_sky_arcsec
            + (star.rate_az_sky_arcsec_s or 0.0) * moved_s,
            expected_el_sky_arcsec=star.el_sky_arcsec
            + (star.rate_el_sky_arcsec_s or 0.0) * moved_s,
            star_flux_dn=star.star_flux_dn,
            rate_az_sky_arcsec_s=star.rate_az_sky_arcsec_s,
            rate_el_sky_arcsec_s=star.rate_el_sky_arcsec_s,
            search_radius_sky_arcsec=step.search_radius_sky_arcsec,
            radius_growth=step.radius_growth,
            max_offset_sky_arcsec=step.max_offset_sky_arcsec,
            attempts=step.attempts,
            **limits,
        ),
        steps.Hold(
            duration_s=star.duration_s or step.duration_s,
            settle_s=step.settle_s,
            rms_limit_px=step.rms_limit_px,
            **limits,
        ),
    ]


def star_results(attempts: Iterable[SequenceAttempt]) -> list[StarResult]:
    """What came of each star, from the attempts at steps of lists: the last one at each star decides."""
    results: dict[tuple[int, str], StarResult] = {}
    for attempt in attempts:
        if not attempt.star:
            continue
        key = (attempt.step_number, attempt.star)
        figures = msgspec.json.decode(attempt.figures_json, type=dict[str, float | None])
        before = results[key].figures if key in results else {}
        why_not = "" if attempt.outcome == "done" else attempt.message
        results[key] = StarResult(attempt.star, before | figures, why_not)
    return list(results.values())


def evaluate(step: steps.Stars, results: list[StarResult]) -> Result:
    """What came of the list.

    Raises
    ------
    StepFailed
        If fewer stars were held well than the step asks for.
    """
    skipped = [result.name for result in results if result.why_not]
    held = len(results) - len(skipped)
    message = f"{held} of {len(results)} stars held"
    if skipped:
        message += f"; skipped {', '.join(skipped)}"
    if held < step.least_held:
        msg = f"{message}; least_held is {step.least_held}"
        raise StepFailed(msg)
    return Result({"stars": float(len(results)), "held": float(held)}, message)


def _check(step: steps.Stars, rig: Rig, loop_name: str) -> list[str]:
    stars = step.stars or []
    if not stars:
        return ["there are no stars; give stars, or a file of them"]
    names = [star.name for star in stars]
    problems = [f"star {name}: is twice in the list" for name in names if names.count(name) > 1][:1]
    if step.least_held > len(stars):
        problems.append(f"least_held is {step.least_held}; there are {len(stars)} stars")
    check = ACQUIRE["acquire"].check
    return problems + [
        f"star {star.name}: {problem}"
        for star in stars
        for problem in check(steps_of(step, star)[0], rig, loop_name)
    ]


def _never_done(_step: steps.Stars, _view: View) -> None:
    """The runner runs the steps that it is made of."""


STARS = {"stars": Behaviour(frozenset(), _never_done, check=_check)}
