"""The fewest happenings of a plan that still violate what it violated."""

from __future__ import annotations

import msgspec

from benchmarks.swarm.plan import Happening, Plan
from benchmarks.swarm.run import run_plan


def shrunk(plan: Plan) -> Plan:
    """Leave out ever smaller parts of the plan's happenings, as long as its first violation stays."""
    violations = run_plan(plan).violations
    if not violations:
        return plan
    wanted = violations[0].invariant

    def violates(happenings: list[Happening]) -> bool:
        found = run_plan(msgspec.structs.replace(plan, happenings=happenings)).violations
        return any(violation.invariant == wanted for violation in found)

    happenings, parts = list(plan.happenings), 2
    while len(happenings) > 1:
        size = -(-len(happenings) // parts)
        for start in range(0, len(happenings), size):
            fewer = happenings[:start] + happenings[start + size :]
            if violates(fewer):
                happenings, parts = fewer, max(parts - 1, 2)
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(happenings))
    return msgspec.structs.replace(plan, happenings=happenings)
