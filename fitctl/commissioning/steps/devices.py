"""Devices: each answers, and is what the rig file says."""

from __future__ import annotations

from fitctl.commissioning.asking import NOT_STARTED, examine_all, without_mocks
from fitctl.commissioning.outcome import Outcome, Site

_REFERENCED_LATER = {"c887"}
"""All that these report of themselves is put right by their reference move, in a step of its own."""


def check_devices(site: Site) -> Outcome:
    """Ask every device who it is; nothing is set, nothing moves."""
    findings = without_mocks(site.rig, examine_all(site.rig))
    absent = [finding.device for finding in findings if finding.note == NOT_STARTED]
    lines: list[str] = []
    troubles = [f"{', '.join(absent)}: {NOT_STARTED}, then the step again"] if absent else []
    figures: dict[str, float] = {}
    for finding in findings:
        who = finding.identity
        name = "" if who is None else " ".join(filter(None, (who.maker, who.model, who.serial)))
        said = [f"{finding.device}: {one}" for one in finding.disagreements]
        of_later = finding.driver in _REFERENCED_LATER and who is not None
        (lines if of_later else troubles).extend(said)
        if finding.round_trip_ms is not None:
            figures[f"{finding.device}_round_trip_ms"] = finding.round_trip_ms
            lines.append(f"{finding.device}: {name}, {finding.round_trip_ms:.2f} ms a question")
    return Outcome(lines, figures, trouble="; ".join(troubles))
