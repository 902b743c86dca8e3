"""The tables of docs/fault-catalogue.md from the results of a run: ``python -m faults.report FILE``."""

import json
import re
import sys
from pathlib import Path

from documents import ROOT, table

from .entries.catalogue import GROUPS
from .entries.configuration import WRONG
from .entries.entry import HOLDS, STAYED, WAITS

DOCS = ROOT / "docs"
TOTALS = DOCS / "reliability.md"
CATALOGUE = DOCS / "fault-catalogue.md"
HEADER = [
    "what is struck",
    "how",
    "in",
    "the loop is then",
    "it says",
    "within",
    "took",
    "back after",
]
MEASURED = 2  # columns, the last ones
ELSEWHERE = "fit-mock"  # where a rig is not named


OTHERS = {STAYED: "stays", HOLDS: "holds its star", WAITS: "waits"}


def promised(entry):
    """What the table says of an entry before anything is measured."""
    rig = "" if entry.rig == ELSEWHERE else f" ({entry.rig})"
    ends = " or ".join(sorted(entry.modes))
    moves = f"; {entry.moves}" if entry.moves else ""
    name = f"{entry.loop} " if entry.others else ""
    others = "".join(f"; {other} {OTHERS.get(end, end)}" for other, end in entry.others)
    return [
        f"{entry.struck}{rig}",
        entry.how,
        name + entry.mode,
        name + ends + others + moves,
        f"`{entry.says}`" if entry.says else "",
        f"{entry.within_s:g} s",
    ]


def measured(entry, result):
    """What a run has found: how long until it was so, and from healing to holding the star again."""
    if result is None:
        return ["no result", ""]
    again = f", try {result['attempts']}" if result["attempts"] > 1 else ""
    nothing_to_wait_for = STAYED in entry.ends and not entry.says
    took = f"{result['took_s']:.2f} s"
    if nothing_to_wait_for:
        took = "stayed" if result["ended"] == entry.mode else result["ended"]
    return [took + again, f"{result['back_s']:.0f} s"]


def running_table(entries, results):
    """One group of entries."""
    return table(HEADER, [promised(e) + measured(e, results.get(e.name)) for e in entries])


def wrong_table():
    """The wrong configurations, none of which needs a clock."""
    rows = [[wrong.what, f"`{wrong.says}`"] for wrong in WRONG]
    return table(["what is wrong", "the line says"], rows)


def records_table(results):
    """What the console of each instrument was shown, and what was lost."""
    rows = [
        [name.removeprefix("records: "), *(str(result[key]) for key in RECORDS)]
        for name, result in results.items()
        if name.startswith("records: ")
    ]
    return table(["rig, entries", *RECORDS], rows)


def run_line(results):
    """How many entries have a result, and of which runs, when and where."""
    entries = [entry for group in GROUPS.values() for entry in group]
    known = [results[entry.name] for entry in entries if entry.name in results]
    first = sum(result["attempts"] == 1 for result in known)
    runs = "; ".join(
        f"{sum(result['run'] == begun for result in known)} of a run of {run['took_min']:g} min "
        f"on {begun[:10]}, load average {run['load']:g}, {run['cores']} cores"
        for begun, run in results["runs"].items()
    )
    return (
        f"*{len(known)} of {len(entries)} entries have a result, {first} at the first try; "
        "an entry is tried again only if the machine itself stood still. "
        f"The results, from a virtual machine: {runs}.*"
    )


RECORDS = ("shown", "missing", "counted", "with a killed supervisor", "logs")


def tables(results):
    """Every table of the catalogue's page by its name there."""
    return {name: running_table(entries, results) for name, entries in GROUPS.items()} | {
        "wrong-configuration": wrong_table(),
        "records": records_table(results),
    }


def fill(page, contents):
    """Put contents between the comments of a page that have their names."""
    text = page.read_text(encoding="utf-8")
    for name, lines in contents.items():
        begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
        pattern = re.escape(begin) + ".*?" + re.escape(end)
        text, found = re.subn(
            pattern, lambda _, new=begin + lines + "\n" + end: new, text, flags=re.DOTALL
        )
        if found != 1:
            sys.exit(f"{page}: {found} places for the table {name}; expected one")
    page.write_text(text, encoding="utf-8")


def main():
    """Put the tables into their page, and the totals into the other."""
    results = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    fill(CATALOGUE, tables(results))
    fill(TOTALS, {"run": run_line(results)})


if __name__ == "__main__":
    main()
