"""Swarm: short nights on virtual time in which devices fail and operators meddle, each from one seed.

Prints one JSON object: simulated hours, happenings by kind, pairs of kinds that met within a second, what was
violated, each time with the happenings that suffice for it. Exit status 1 if anything was. ``--replay SEED``
repeats one run and prints what happened in it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import count, repeat
from random import Random
from typing import Any, NamedTuple

import msgspec

from benchmarks.swarm.happenings import Plan
from benchmarks.swarm.invariants import NO_EXCEPTION
from benchmarks.swarm.past import DEFECTS, put_back
from benchmarks.swarm.plan import plan_of
from benchmarks.swarm.run import Result, failed_run, run_plan
from benchmarks.swarm.shrink import shrunk, shrunk_from
from benchmarks.swarm.wires.drivers import NIGHTS
from fitctl.logging.records import AnyRecord, Event
from fitctl.processes import ended_by_signals

_RUNS_A_SEED = 1_000_000
_MET_S = 1.0
_SHOWN = 10
_MOST_TRIALS = 100  # runs in which the plan of a violation is shrunk
_ENDING = threading.Event()  # a signal came; each process of the swarm has its own
_DIED = "a process of the swarm died in one of these seeds: "


class Run(NamedTuple):
    """One run of a seed; `shrunk` is what remains of a plan that violated something."""

    plan: Plan
    result: Result
    shrunk: Plan | None = None


def run_seed(seed: int, defect: str = "") -> Run:
    """One run, with a defect of the past put back; for a process of its own."""
    try:
        plan = plan_of(seed)
    except Exception as error:
        return Run(
            Plan(seed=seed, rig="", settings=[], duration_s=0.0, happenings=[]), failed_run(error)
        )
    with put_back(defect):
        return Run(plan, run_plan(plan))


def run_and_shrink(seed: int) -> Run:
    """One run; if it violates something, also the plan without what that does not need."""
    run = run_seed(seed)
    violations = run.result.violations
    if not violations:
        return run
    first = violations[0]
    print(f"\n{seed} violates: {first.invariant}; it is being shrunk", file=sys.stderr, flush=True)
    return run._replace(shrunk=shrunk_from(run.plan, first, _MOST_TRIALS, _ENDING.is_set))


def met(plan: Plan) -> Iterator[tuple[str, str]]:
    """Pairs of kinds of happenings that came within a second of each other."""
    happenings = plan.happenings
    for number, one in enumerate(happenings):
        for other in happenings[number + 1 :]:
            if other.at_s - one.at_s > _MET_S:
                break
            first, second = sorted((one.kind, other.kind))
            yield first, second


class Totals:
    """What the runs of a swarm amount to.

    Attributes
    ----------
    found : list
        A finding for each run that violated something.
    """

    def __init__(self) -> None:
        self.found: list[dict[str, object]] = []
        self._started_s, self._runs = time.monotonic(), 0
        self._simulated_s: defaultdict[str, float] = defaultdict(float)  # by rig
        self._cpu_s: defaultdict[str, float] = defaultdict(float)
        self._kinds: Counter[str] = Counter()
        self._modes: Counter[str] = Counter()
        self._pairs: Counter[tuple[str, str]] = Counter()

    def add(self, run: Run) -> None:
        """Add a run, and print at once what it violated."""
        plan, result, _ = run
        self._runs += 1
        self._simulated_s[plan.rig] += result.lasted_s
        self._cpu_s[plan.rig] += result.cpu_s
        self._kinds.update(happening.kind for happening in plan.happenings)
        self._modes.update(result.modes)
        self._pairs.update(met(plan))
        if result.violations:
            self.found.append(finding(run))
            print(f"\n{json.dumps(self.found[-1])}", file=sys.stderr, flush=True)

    @property
    def simulated_s(self) -> float:
        """Of all runs."""
        return sum(self._simulated_s.values())

    def progress(self, hours: float) -> None:
        """Draw the progress bar."""
        _progress(self.simulated_s / 3600, hours, len(self.found), self._started_s)

    def as_object(self, seed: int) -> dict[str, Any]:
        """The object that the command prints."""
        simulated_s, cpu_s, pairs = self.simulated_s, sum(self._cpu_s.values()), self._pairs
        return {
            "seed": seed,
            "runs": self._runs,
            "simulated_hours": round(simulated_s / 3600, 3),
            "took_s": round(time.monotonic() - self._started_s, 1),
            "real_time_factor_per_core": round(simulated_s / cpu_s, 1) if cpu_s else None,
            "real_time_factor_of_rigs": {
                rig: round(self._simulated_s[rig] / rig_cpu_s, 1)
                for rig, rig_cpu_s in self._cpu_s.items()
                if rig_cpu_s
            },
            "happenings": dict(self._kinds.most_common()),
            "modes_entered": dict(self._modes.most_common()),
            "kinds_that_met_within_1_s": len(pairs),
            "pairs_that_met_within_1_s": {" + ".join(pair): n for pair, n in pairs.most_common()},
            "violations": self.found,
        }


def swarm(seed: int, hours: float, jobs: int) -> dict[str, Any]:
    """Run until so many hours are simulated, a thing was violated in ten runs, or somebody presses Ctrl-C.

    Runs that have begun then are finished and counted; a plan that is being shrunk after Ctrl-C stays as long
    as it then is. The swarm also ends if a process of the pool dies.
    """
    totals = Totals()
    seeds = (seed * _RUNS_A_SEED + number for number in count())
    running: dict[Future[Run], int] = {}
    # Its processes inherit the handler, and finish their runs.
    with ended_by_signals(_ENDING.set), ProcessPoolExecutor(jobs) as pool:
        try:
            while (
                totals.simulated_s < 3600 * hours
                and len(totals.found) < _SHOWN
                and not _ENDING.is_set()
            ):
                while len(running) < 2 * jobs:
                    begun = next(seeds)
                    running[pool.submit(run_and_shrink, begun)] = begun
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    totals.add(future.result())
                    del running[future]
                totals.progress(hours)
            pool.shutdown(cancel_futures=True)
            for future in [each for each in running if not each.cancelled()]:
                totals.add(future.result())
                del running[future]
        except BrokenProcessPool:
            detail = _DIED + ", ".join(map(str, sorted(running.values())))
            totals.found.append({"violated": [{"invariant": NO_EXCEPTION, "detail": detail}]})
    return totals.as_object(seed)


def find(defect: str, seed: int, hours: float, jobs: int) -> dict[str, object]:
    """How many hours it takes until a defect of the past is found, no more than so many."""
    simulated_s, runs = 0.0, 0
    with ProcessPoolExecutor(jobs) as pool:
        while simulated_s < 3600 * hours:
            first = seed * _RUNS_A_SEED + runs
            for plan, result, _ in pool.map(
                run_seed, range(first, first + 2 * jobs), repeat(defect)
            ):
                runs += 1
                simulated_s += result.lasted_s
                if result.violations and _by_the_defect(plan.seed, result):
                    return {
                        "hours": round(simulated_s / 3600, 3),
                        "runs": runs,
                        "seed": plan.seed,
                        "violated": result.violations[0].invariant,
                        "detail": result.violations[0].detail,
                    }
    return {"hours": None, "not_in_hours": round(simulated_s / 3600, 3), "runs": runs}


def _by_the_defect(seed: int, result: Result) -> bool:
    """Whether the run without the defect does not violate the same."""
    clean = run_seed(seed).result.violations
    return result.violations[0].invariant not in {one.invariant for one in clean}


def finding(run: Run) -> dict[str, object]:
    """What the object says of a run that violated something."""
    plan, result, fewest = run
    return {
        "seed": plan.seed,
        "replay": f"python -m benchmarks.swarm --replay {plan.seed}",
        "rig": plan.rig,
        "settings": list(plan.settings),
        "violated": [violation._asdict() for violation in result.violations],
        "happenings": len(plan.happenings),
        "remain": [] if fewest is None else msgspec.to_builtins(fewest.happenings),
    }


def _progress(done_h: float, hours: float, found: int, started_s: float) -> None:
    part = min(1.0, done_h / hours)
    bar = ("#" * round(30 * part)).ljust(30)
    line = f"[{bar}] {done_h:8.2f} of {hours:g} h, {found} violated, {time.monotonic() - started_s:.0f} s"
    if sys.stderr.isatty():
        print(f"\r{line}", end="" if part < 1 else "\n", file=sys.stderr, flush=True)
    elif part >= 1:
        print(line, file=sys.stderr, flush=True)


def replay(plan: Plan) -> int:
    """Repeat one run, and print its happenings and events in their order."""
    happenings = list(plan.happenings)

    def show(record: AnyRecord) -> None:
        while happenings and happenings[0].at_s <= record.time_s:
            happening = happenings.pop(0)
            print(f"{happening.at_s:10.4f}  > {msgspec.json.encode(happening).decode()}")
        if isinstance(record, Event):
            print(f"{record.time_s:10.4f}  {record.severity:8}{record.source}: {record.message}")

    result = run_plan(plan, show)
    print(f"records {result.digest}, {result.lasted_s:g} s")
    for violation in result.violations:
        print(f"VIOLATED at {violation.at_s:.4f} s: {violation.invariant}: {violation.detail}")
    return 1 if result.violations else 0


def wires(seed: int, runs: int) -> dict[str, dict[str, object]]:
    """Each driver against its mock over a bad wire, so many nights of sixty calls each."""
    found: dict[str, dict[str, object]] = {}
    for name, night in NIGHTS.items():
        ended: Counter[str] = Counter()
        mistaken = []
        for number in range(runs):
            random = Random(f"{seed} {number} {name}")  # noqa: S311 - a repeatable draw
            try:
                ended.update(night(random))
            except Exception as error:  # whatever it is, it is none that a driver may raise
                mistaken.append(f"{seed} {number} {name}: {error!r}")
        found[name] = {"calls_ended_in": dict(ended.most_common()), "mistaken": mistaken[:_SHOWN]}
        print(f"{name}: {json.dumps(found[name])}", file=sys.stderr, flush=True)
    return found


def past(names: list[str], seed: int, hours: float, jobs: int) -> int:
    """Put defects back one after the other, and print how soon each is found."""
    found = {}
    for name in names:
        found[name] = {"was": DEFECTS[name].what} | find(name, seed, hours, jobs)
        print(f"{name}: {json.dumps(found[name])}", file=sys.stderr, flush=True)
    print(json.dumps(found, indent=1))
    return 1 if any(one["hours"] is None for one in found.values()) else 0


def main() -> int:
    """Run, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=1.0, help="to simulate")
    parser.add_argument("--seed", type=int, help="by default drawn, and printed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--replay", type=int, metavar="SEED", help="one run, with what happened")
    parser.add_argument("--shrink", action="store_true", help="first leave out what need not be")
    parser.add_argument(
        "--past",
        nargs="*",
        metavar="NAME",
        help="put defects of the past back, by default each, and show how soon they are found: "
        + ", ".join(DEFECTS),
    )
    parser.add_argument(
        "--wires", type=int, metavar="NIGHTS", help="each driver over a bad wire, so often"
    )
    options = parser.parse_args()
    if options.wires is not None:
        wired = wires(options.seed or 1, options.wires)
        print(json.dumps(wired, indent=1))
        return 1 if any(each["mistaken"] for each in wired.values()) else 0
    if options.past is not None:
        return past(options.past or list(DEFECTS), options.seed or 1, options.hours, options.jobs)
    if options.replay is not None:
        plan = plan_of(options.replay)
        return replay(shrunk(plan, _MOST_TRIALS) if options.shrink else plan)
    seed = options.seed if options.seed is not None else int.from_bytes(os.urandom(2))
    print(f"seed {seed}", file=sys.stderr)
    found = swarm(seed, options.hours, options.jobs)
    print(json.dumps(found, indent=1))
    for violation in found["violations"]:  # last: of a long log, often only the end is kept
        print(violation.get("replay"), violation["violated"][0], file=sys.stderr)
    return 1 if found["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
