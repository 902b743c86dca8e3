"""The table of docs/commissioning.md from the results of a run: ``python -m miswired.report FILE``."""

import json
import re
import sys
from pathlib import Path

from documents import ROOT, table

from .catalogue import CATALOGUE

PAGE = ROOT / "docs" / "commissioning.md"
HEADER = ["what is wrong", "must be", "result", "largest motion of a motor", "of a stack", "took"]
MARKED = re.compile(r"(<!-- results: begin -->\n).*?(<!-- results: end -->)", re.DOTALL)


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
        f"`{key.removeprefix('loops.right.')}`" for key, value in result["found"].items()
    )
    return f"corrected: {keys}" if keys else "passed"


def rows(results):
    """A row for each entry."""
    for entry in CATALOGUE:
        result = results.get(entry.name)
        measured = ["", "", ""]
        if result is not None:
            measured = [
                f"{result['most_rad']:.3f} of {entry.most_rad:g} rad",
                f"{result['most_v']:.2f} of {entry.most_v:g} V",
                f"{result['took_s']:.0f} s",
            ]
        yield [entry.name, promised(entry), outcome(result), *measured]


def main(path):
    """Write the table."""
    results = json.loads(Path(path).read_text())
    text = table(HEADER, rows(results))
    PAGE.write_text(MARKED.sub(lambda m: m[1] + text + "\n" + m[2], PAGE.read_text()))


if __name__ == "__main__":
    main(sys.argv[1])
