"""What a soak found, as figures and as Markdown."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from statistics import median
from typing import Any

from msgspec.structs import asdict

from benchmarks.soak.growth import QUANTITIES, Growth
from benchmarks.soak.logs import Audit
from benchmarks.soak.run import BACK_WITHIN_S, Soak

_UNITS = {"rss_mb": "memory, MB", "handles": "handles", "threads": "threads"}
_TOLD = 8  # events of a strike that the loop did not come back from; all are in the JSON
_RUN_INFO = 1  # the run's description is offered too; it is no message of a file, but its metadata


def figures(soak: Soak, audit: Audit, seed: int, lasted_s: float, ended: str) -> dict[str, Any]:
    """All of it; times in the units of their names."""
    course = soak.course
    losses = asdict(course.losses) if course.losses else {}
    offered, lost = losses.get("records_offered", 0), losses.get("records_lost", 0)
    return {
        "seed": seed,
        "lasted_s": lasted_s,
        "ended": ended,
        "strikes": [strike._asdict() for strike in course.struck],
        "not_back": [s._asdict() for s in course.struck if s.back_s > BACK_WITHIN_S],
        "left_vernier_without_fault": course.departures,
        "growth": {
            role: {name: growth._asdict() for name, growth in rows.items()}
            for role, rows in soak.samples.growth().items()
        },
        "quiet": course.spans[True].figures(),
        "struck": course.spans[False].figures(),
        "load": {"median": median(soak.load), "most": max(soak.load)} if soak.load else {},
        "telemetry_missed": course.messages_missed,
        "queues": losses,
        "records": {
            "offered": offered,
            "counted_lost": lost,
            "written": audit.written,
            "written_twice": audit.twice,
            "not_accounted_for": offered - _RUN_INFO - audit.written - lost,
        },
        "logs": {
            "files": audit.files,
            "cut_by_a_kill": audit.cut,
            "problems": audit.problems,
            "bytes": audit.size_bytes,
            "most_on_disk_bytes": soak.most_disk_bytes,
        },
    }


def sound(found: dict[str, Any]) -> bool:
    """Whether nothing is wrong that a soak must not find; growth is for people to judge."""
    return not (
        found["ended"]
        or found["not_back"]
        or found["logs"]["problems"]
        or found["records"]["not_accounted_for"]
    )


def markdown(found: dict[str, Any]) -> str:
    """A section for docs/soak.md: tables, then what went wrong."""
    wrong = [found["ended"]] if found["ended"] else []
    wrong += [
        f"{s['name']}: {s['back_s']:.0f} s; {'; '.join(s['told'][-_TOLD:])}"
        for s in found["not_back"]
    ]
    wrong += [f"without a fault: {why}" for why in found["left_vernier_without_fault"]]
    wrong += found["logs"]["problems"]
    tables = (
        _table(("the whole", ""), _whole(found)),
        _table(
            ("process", "", "after warm-up", "at the end", "most", "growth an hour", "95 %"),
            _growth_rows(found["growth"]),
        ),
        _table(
            ("timing", "without a fault", "from a fault until back"),
            (
                (_name(key), _number(value), _number(found["struck"][key]))
                for key, value in found["quiet"].items()
            ),
        ),
        _slowest(found["strikes"]),
        "\n".join(f"- {line}" for line in wrong),
    )
    return "\n\n".join(filter(None, tables))


def _whole(found: dict[str, Any]) -> Iterable[tuple[str, str]]:
    records, logs, strikes = found["records"], found["logs"], found["strikes"]
    back_s = [strike["back_s"] for strike in strikes]
    yield "lasted, min", f"{found['lasted_s'] / 60:.1f}"
    yield "seed", str(found["seed"])
    if strikes:
        kinds = len({strike["name"] for strike in strikes})
        yield "strikes", f"{len(strikes)}, of {kinds} kinds"
        yield (
            "back in VERNIER after, s",
            f"{median(back_s):.1f} (median), {max(back_s):.1f} (worst)",
        )
    yield f"not back within {BACK_WITHIN_S:g} s", str(len(found["not_back"]))
    yield "left VERNIER without a fault", str(len(found["left_vernier_without_fault"]))
    if found["load"]:
        load = found["load"]
        yield "load of the machine", f"{load['median']:.1f} (median), {load['most']:.1f} (most)"
    yield "records offered to the log", str(records["offered"])
    yield "of these in its files", f"{records['written']}, {records['written_twice']} of them twice"
    yield "counted as lost", str(records["counted_lost"])
    yield "not accounted for", str(records["not_accounted_for"])
    yield "files", f"{logs['files']}, {logs['bytes'] / 1e6:.0f} MB together"
    yield "cut off by a kill, and mended", str(logs["cut_by_a_kill"])
    yield "problems in them", str(len(logs["problems"]))
    yield "most on the disk, MB", f"{logs['most_on_disk_bytes'] / 1e6:.0f}"
    yield "telemetry that its client missed", str(found["telemetry_missed"])
    for name, count in found["queues"].items():
        if name.endswith("_unsent"):
            yield name.replace("_", " "), str(count)


def _growth_rows(growth: dict[str, dict[str, Any]]) -> Iterable[tuple[str, ...]]:
    for role, rows in growth.items():
        for name in QUANTITIES:
            row = Growth(**rows[name])
            yield (
                role,
                _UNITS[name],
                *(f"{value:.1f}" for value in (row.first, row.last, row.most)),
                "too short" if math.isnan(row.per_hour) else f"{row.per_hour:+.2f}",
                "" if math.isnan(row.low) else f"{row.low:+.2f} to {row.high:+.2f}",
            )


def _slowest(strikes: list[dict[str, Any]]) -> str:
    """Kinds of strike by how long the loop took to come back, the slowest first."""
    by_name: dict[str, list[float]] = defaultdict(list)
    for strike in strikes:
        by_name[strike["name"]].append(strike["back_s"])
    rows = sorted(by_name.items(), key=lambda row: -max(row[1]))
    return _table(
        ("strike", "times", "back after s, median", "worst"),
        (
            (name, str(len(back)), f"{median(back):.1f}", f"{max(back):.1f}")
            for name, back in rows[:10]
        ),
    )


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


def _name(key: str) -> str:
    words = key.replace("_ms", ", ms").replace("_", " ")
    return words.replace(" 99", ", 99 %")


def _number(value: float) -> str:
    return f"{value:d}" if isinstance(value, int) else f"{value:.2f}"
