"""Soak: hours on mocks with random faults, and what grew, what was late, what was lost, what did not come back.

Mocks, supervisor, recorder and a console are real processes on their real wires. One fault after the
other strikes, of every kind that the mock devices have, and of processes and operators; each is held for a
while and ended, and then the loop must be brought back to VERNIER by recover and acquire. The same seed
strikes in the same order. Exit status 1 if something did not come back, a log is not whole or a record is
missing without being counted. Ctrl-C ends it early, with its report.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

from benchmarks.soak.report import figures, markdown, sound
from benchmarks.soak.run import Failed, Soak, soaking
from fitctl.demo import DemoError
from fitctl.processes import ended_by_signals


def tell(soak: Soak, what: str) -> None:
    """A line of progress on standard error."""
    course, newest = soak.course, soak.samples.newest
    quiet = course.spans[True].figures()
    print(
        f"{time.monotonic() - soak.started_s:7.0f} s  {len(course.struck):4} strikes  "
        f"supervisor {newest('supervisor'):.0f} MB, recorder {newest('recorder'):.0f} MB  "
        f"tick 99 % {quiet['tick_99_ms']:.1f} ms, worst {quiet['tick_worst_ms']:.1f} ms  "
        f"lost {course.losses.records_lost if course.losses else 0}  {what}",
        file=sys.stderr,
        flush=True,
    )


def main() -> int:
    """Soak, and print the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=3600.0, help="seconds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="of the rig"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="all figures go there")
    options = parser.parse_args()
    stop = threading.Event()
    ended = ""
    with (
        ended_by_signals(stop.set),
        tempfile.TemporaryDirectory(prefix="fitctl-soak-") as folder,
    ):
        with soaking(Path(folder), options.set, options.seed, stop) as (soak, audit):
            try:
                soak.run(options.duration, random.Random(options.seed), tell)  # noqa: S311
                soak.shut_down()
            except (Failed, DemoError, ConnectionError) as error:
                ended = str(error)
            lasted_s = time.monotonic() - soak.started_s
        audit.finish()
        found = figures(soak, audit, options.seed, lasted_s, ended)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    print(markdown(found))
    return 0 if sound(found) else 1


if __name__ == "__main__":
    sys.exit(main())
