"""What `fitctl sequence` prints of a run: where it is, its attempts, its stars."""

from __future__ import annotations

import math

import msgspec

from fitctl.commands.shared.printing import to_json
from fitctl.logging.records import SequenceAttempt
from fitctl.messages.commands import SequenceStatus
from fitctl.sequences.behaviours.stars import StarResult, star_results


def where(status: SequenceStatus) -> str:
    """Where a sequence is, in one line."""
    again = f", attempt {status.attempt}" if status.attempt > 1 else ""
    state = "" if status.state == "running" else f" {status.state}"
    star = f" {status.message}" if status.state == "running" and status.message else ""
    return f"{status.name}{state} {status.step_number}/{status.steps} {status.step}{star}{again}"


def attempts_text(attempts: list[SequenceAttempt]) -> str:
    """One line for each attempt, its times the instrument's; then a table of the stars, if there were any.

    Where several loops had steps, each line names its loop.
    """
    loops = {each.loop for each in attempts}
    columns = max(map(len, loops), default=0) + 2 if len(loops) > 1 else 0
    head = f"{'step':>4}  {'':<11}  {'':<{columns}}{'try':>3}  {'outcome':<9}  {'s':>7}"
    lines = [
        f"{each.step_number:>4}  {each.step:<11}  {each.loop if columns else '':<{columns}}"
        f"{each.attempt:>3}  {each.outcome:<9}  "
        f"{each.ended_s - each.began_s:>7.1f}  {_of_star(each)}{each.message}".rstrip()
        for each in attempts
    ]
    return "\n".join([head, *lines, *_stars(star_results(attempts))])


def _of_star(attempt: SequenceAttempt) -> str:
    return f"{attempt.star}: " if attempt.star else ""


def _stars(results: list[StarResult]) -> list[str]:
    """One line for each star: where it was found, how well it was held, or why it was skipped."""
    if not results:
        return []
    width = max(len("star"), *(len(result.name) for result in results))
    head = (
        f"{'star':<{width}}  {'az arcsec':>9}  {'el arcsec':>9}  {'az px RMS':>9}  {'el px RMS':>9}"
    )
    columns = (
        ("found_az_sky_arcsec", ".1f"),
        ("found_el_sky_arcsec", ".1f"),
        ("rms_az_px", ".4f"),
        ("rms_el_px", ".4f"),
    )
    lines = []
    for result in results:
        shown = [f"{_figure(result, key, form):>9}" for key, form in columns]
        lines.append(f"{result.name:<{width}}  {'  '.join(shown)}  {result.why_not}".rstrip())
    return ["", head, *lines]


def _figure(result: StarResult, key: str, form: str) -> str:
    value = result.figures.get(key)
    return "-" if value is None or math.isnan(value) else f"{value:{form}}"


def as_json_text(name: str, failure: str, attempts: list[SequenceAttempt]) -> str:
    """All of it as one JSON object."""
    plain = [
        msgspec.to_builtins(each) | {"figures": msgspec.Raw(each.figures_json.encode())}
        for each in attempts
    ]
    for each in plain:
        del each["figures_json"]
    document = {"sequence": name, "failure": failure, "attempts": plain}
    return to_json(document)
