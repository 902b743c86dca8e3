"""The tables of docs/commissioning.md from the results of a run: ``python -m miswired.report FILE``."""

import json
import re
import sys
from pathlib import Path

from documents import ROOT, table

from fitctl.commissioning.outcome import Site
from fitctl.commissioning.tasks import STEPS
from fitctl.config import default_rig_path, load_rig

from .catalogue import CATALOGUE, TESTBED

PAGE = ROOT / "docs" / "commissioning.md"
HEADER = ["what is wrong", "must be", "result", "largest motion of a motor", "of a stack", "took"]
STEPS_HEADER = ["step", "what it proves", "what it moves", "needs", "takes"]


def promised(entry):
    """What the catalogue asks for."""
    if entry.named:
        return "named"
    return "corrected" if entry.found else "passed"


def outcome(result):
    """What was found, and whether it was corrected or named."""
    if result is None:
        return "no result"
    if result["troubles"]:
        return f"named by `{next(iter(result['troubles'])).rpartition('.')[2]}`"
    keys = ", ".join(
        f"`{key.removeprefix('loops.right.').removeprefix('loops.')}`"
        for key, value in result["found"].items()
    )
    return f"corrected: {keys}" if keys else "passed"


def kept_rows(page):
    """The rows that the page has, by what is wrong: a run may have been of some entries only."""
    within = re.search(r"<!-- results: begin -->\n(.*?)<!-- results: end -->", page, re.DOTALL)
    lines = within[1].splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    return {row[0]: row for row in cells if len(row) == len(HEADER)}


def rows(results, kept):
    """A row for each entry: of this run or, where it did not have the entry, of an earlier one."""
    for entry in CATALOGUE:
        result = results.get(entry.name)
        if result is None and entry.name in kept:
            yield kept[entry.name]
            continue
        measured = ["", "", ""]
        if result is not None:
            measured = [
                f"{result['most_rad']:.3f} of {entry.most_rad:g} rad",
                f"{result['most_v']:.2f} of {entry.most_v:g} V",
                f"{result['took_s']:.0f} s",
            ]
        yield [entry.name, promised(entry), outcome(result), *measured]


def steps_table():
    """A row for each step, as it is on the default rig; of a metrology loop, on the testbed."""
    one, whole = load_rig(default_rig_path()), load_rig(default_rig_path().with_name(TESTBED))
    loops = {"rig": "", "siderostat": "right", "star": "right"}
    linked = {"feedforward": "left"}
    rows = []
    for name, step in STEPS.items():
        rig = one if step.of in loops else whole
        name_of = (loops | linked).get(step.of, "metrology")
        site = Site(rig, name_of, print, default_rig_path(), ())
        needs = ", ".join(f"`{one}`" for one in step.needs)
        rows.append([f"`{name}`", step.title, step.moves(site), needs, f"{step.takes_s:g} s"])
    return table(STEPS_HEADER, rows)


def marked(page, name, text):
    """The page with a text between the marks of that name."""
    within = re.compile(rf"(<!-- {name}: begin -->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    return within.sub(lambda m: m[1] + text + "\n" + m[2], page)


def main(path):
    """Write both tables."""
    results = json.loads(Path(path).read_text())
    page = marked(PAGE.read_text(), "steps", steps_table())
    PAGE.write_text(marked(page, "results", table(HEADER, rows(results, kept_rows(page)))))


if __name__ == "__main__":
    main(sys.argv[1])
