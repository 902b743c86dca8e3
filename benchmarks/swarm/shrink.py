"""The fewest happenings of a plan that still violate what it violated."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from benchmarks.swarm.happenings import Happening, Plan
from benchmarks.swarm.invariants import Violation
from benchmarks.swarm.run import run_plan


def shrunk(plan: Plan, most_runs: float = math.inf) -> Plan:
    """Leave out parts of the plan's happenings, as long as its first violation stays.

    Parameters
    ----------
    plan : Plan
    most_runs : float
        After so many trial runs, the plan is returned as it then is.
    """
    violations = run_plan(plan).violations
    return shrunk_from(plan, violations[0], most_runs) if violations else plan


def shrunk_from(
    plan: Plan,
    violation: Violation,
    most_runs: float = math.inf,
    is_over: Callable[[], bool] = lambda: False,
) -> Plan:
    """As :func:`shrunk`, for a plan whose first violation is known, and only until `is_over`."""
    runs = 0

    def is_enough() -> bool:
        return runs >= most_runs or is_over()

    def violates(happenings: list[Happening]) -> bool:
        nonlocal runs
        runs += 1
        found = run_plan(msgspec.structs.replace(plan, happenings=happenings)).violations
        return any(one.invariant == violation.invariant for one in found)

    happenings, parts, begin = list(plan.happenings), 2, 0
    # Most of what comes after the violation cannot have caused it.
    before = [happening for happening in happenings if happening.at_s <= violation.at_s]
    if 0 < len(before) < len(happenings) and not is_enough() and violates(before):
        happenings = before
    while len(happenings) > 1 and not is_enough():
        size = -(-len(happenings) // parts)
        for start in range(begin, len(happenings), size):
            if is_enough():
                break
            fewer = happenings[:start] + happenings[start + size :]
            if violates(fewer):
                # What was tried before is needed most likely: go on with what follows.
                happenings, parts, begin = fewer, max(parts - 1, 2), start
                break
        else:
            if begin:
                begin = 0
                continue
            if size == 1:
                break
            parts = min(2 * parts, len(happenings))
    return msgspec.structs.replace(plan, happenings=happenings)
