"""What a soak found, as figures and as Markdown."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from statistics import median
from typing import Any

from benchmarks.soak.growth import QUANTITIES, Growth
from benchmarks.soak.logs import Audit
from benchmarks.soak.run import BACK_WITHIN_S, Soak

_UNITS = {"rss_mb": "memory, MB", "handles": "handles", "threads": "threads"}
_RUN_INFO = 1  # the run's description is offered too; it is no message of a file, but its metadata


def figures(soak: Soak, audit: Audit, seed: int, lasted_s: float, ended: str) -> dict[str, Any]:
    """All of it; times in the units of their names."""
    course = soak.course
    lost = {"offered": course.records_offered, "counted_lost": course.records_lost}
    lost |= {"written": audit.written, "written_twice": audit.twice}
    lost["not_accounted_for"] = lost["offered"] - _RUN_INFO - lost["written"] - lost["counted_lost"]
    return {
        "seed": seed,
        "lasted_s": lasted_s,
        "ended": ended,
        "strikes": [strike._asdict() for strike in course.struck],
        "not_back": [s._asdict() for s in course.struck if s.back_s > BACK_WITHIN_S],
        "left_vernier_unstruck": course.departures,
        "growth": {
            role: {name: growth._asdict() for name, growth in rows.items()}
            for role, rows in soak.samples.growth().items()
        },
        "quiet": course.spans[True].figures(),
        "struck": course.spans[False].figures(),
        "telemetry_missed": course.messages_missed,
        "records": lost,
        "logs": {
            "files": audit.files,
            "cut_by_a_kill": audit.cut,
            "problems": audit.problems,
            "bytes": audit.bytes,
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
    """A section for docs/reliability.md."""
    records, logs = found["records"], found["logs"]
    back = sorted(strike["back_s"] for strike in found["strikes"])
    lines = [
        f"{found['lasted_s'] / 60:.0f} minutes, seed {found['seed']}; {_count(len(back), 'strike')}, of "
        f"{_count(len({strike['name'] for strike in found['strikes']}), 'kind')}. "
        + (
            f"The loop was back in VERNIER after {median(back):.1f} s (median), {back[-1]:.1f} s at worst; "
            if back
            else ""
        )
        + f"{len(found['not_back'])} took longer than {BACK_WITHIN_S:g} s. Unstruck, it left VERNIER "
        f"{_count(len(found['left_vernier_unstruck']), 'time')}.",
        "",
        _table(
            (
                "process",
                "quantity",
                "after warm-up",
                "at the end",
                "most",
                "growth an hour",
                "95 %",
            ),
            _growth_rows(found["growth"]),
        ),
        "",
        _table(
            ("", "unstruck", "from a strike until back"),
            (
                (_name(key), _number(value), _number(found["struck"][key]))
                for key, value in found["quiet"].items()
            ),
        ),
        "",
        f"Records: {records['offered']} offered, {records['written']} in the files, {records['counted_lost']} "
        f"counted as lost, {records['not_accounted_for']} not accounted for; {records['written_twice']} are in "
        f"two files. {_count(logs['files'], 'log')} of {logs['bytes'] / 1e6:.0f} MB together, of which "
        f"{logs['cut_by_a_kill']} cut off by a kill and mended; {_count(len(logs['problems']), 'problem')}; "
        f"never more than {logs['most_on_disk_bytes'] / 1e6:.0f} MB on the disk. The telemetry client missed "
        f"{_count(found['telemetry_missed'], 'message')}.",
    ]
    wrong = [found["ended"]] if found["ended"] else []
    wrong += [
        f"{s['name']}: {s['back_s']:.0f} s; {'; '.join(s['told'])}" for s in found["not_back"]
    ]
    wrong += [f"unstruck: {reason}" for reason in found["left_vernier_unstruck"]] + logs["problems"]
    if wrong:
        lines += ["", *(f"- {line}" for line in wrong)]
    return "\n".join([*lines, "", _slowest(found["strikes"])])


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


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
