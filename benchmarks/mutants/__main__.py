"""Mutation testing: change the code in one place, and see whether a test fails.

mutmut makes the mutants; this module draws a random sample of them and runs the tests. mutmut itself cannot
draw a sample. Its operators do not delete statements; the one added here does.

One run of all tests records which of them execute each line, and how long each takes. A mutant then runs
only the tests that execute its statement, fast ones first, until one fails. A statement outside functions runs
at import: its tests are those that execute anything of its module, or else of its folder.

Each worker has a copy of the project in a temporary folder and mutates one module there at a time. Every place
in the code is as likely as any other, however many mutants mutmut makes of it. Strings with a space are texts
for people and stay as they are, and mutmut leaves decorated functions alone.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import datetime
import difflib
import itertools
import json
import multiprocessing
import os
import platform
import queue
import random
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import coverage
import libcst
from mutmut.mutation import file_mutation
from mutmut.mutation.mutators import mutation_operators
from scipy.stats import binomtest

from benchmarks.mutants.plugin import PLUGINS, run_forked

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reliability.md"
ROOMS = ("controllers", "drivers", "logging", "loop", "stages", "supervisor")  # below fitctl/
TESTS = (  # not those of the batch, which compare it with the live loop for minutes
    *(f"tests/{room}" for room in ROOMS),
    "tests/mocks",
    *(
        f"tests/simulation/test_simulated_{what}.py"
        for what in ("devices", "instrument", "testbed")
    ),
    "tests/commands/analyse/test_cli_log.py",
    "tests/test_error_budget.py",
)
# In seconds, and a ratio to the time without the mutant: what takes longer than both together hangs.
LIMIT_S, LIMIT_RATIO = 60.0, 5.0
SLOW_S = 0.5  # fast tests run first
FIRST = 40  # tests before the others are collected
# How often a test may fail by chance before a mutant counts as survived.
TRIES = 3
LIBRARIES = (
    *("control", "foxglove_schemas_protobuf", "hypothesis", "mcap_protobuf.writer", "msgspec"),
    *("numba", "pydantic", "pymodbus.framer", "pytest_textual_snapshot", "pytest_timeout"),
    *("scipy.optimize", "scipy.signal", "serial", "xdist.plugin", "zmq"),
)
# To import the libraries takes longer than most tests: each mutant's process is forked from one that has them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as fitctl.cli
_PROCESSES = multiprocessing.get_context("forkserver")
_PROCESSES.set_forkserver_preload([run_forked.__module__, *LIBRARIES])
COVERAGE = """[run]
source = {folder}/fitctl
data_file = {folder}/.coverage
parallel = true
sigterm = true
context = ${{PYTEST_CURRENT_TEST}}
"""


@dataclass(frozen=True)
class Mutant:
    """One changed place; `line` counts from 1."""

    path: str
    line: int
    diff: str
    code: str

    @property
    def place(self) -> tuple[str, int, str]:
        """What identifies the mutant."""
        return self.path, self.line, self.diff


@dataclass(frozen=True)
class Outcome:
    """What the tests made of a mutant: killed, timeout or survived; `by` is the test that failed."""

    mutant: Mutant
    verdict: str
    by: str
    tests: int
    took_s: float
    load: float

    def report(self) -> dict[str, Any]:
        """The outcome without the mutant's code."""
        values = asdict(self)
        mutant = values.pop("mutant")
        del mutant["code"]
        return mutant | values


def delete_statement(node: libcst.Expr) -> list[libcst.BaseSmallStatement]:
    """An expression that stands as a statement, such as a call, is left out; docstrings stay."""
    is_text = isinstance(node.value, libcst.SimpleString | libcst.ConcatenatedString)
    return [] if is_text else [libcst.Pass()]


def places(path: Path) -> tuple[libcst.Module, list[list[file_mutation.Mutation]]]:
    """A module, and the mutations of each of its places."""
    module, mutations, _, _ = file_mutation.create_mutations(str(path), path.read_text())
    grouped: dict[int, list[file_mutation.Mutation]] = {}
    for mutation in mutations:
        node = mutation.original_node
        if isinstance(node, libcst.SimpleString) and " " in node.value:
            continue
        grouped.setdefault(id(node), []).append(mutation)
    return module, list(grouped.values())


def mutant_of(path: Path, module: libcst.Module, mutation: file_mutation.Mutation) -> Mutant:
    """The module's code with this mutation, and what differs."""
    code = module.deep_replace(mutation.original_node, mutation.mutated_node).code
    lines = list(
        difflib.unified_diff(module.code.splitlines(), code.splitlines(), lineterm="", n=0)
    )
    at_line = int(re.split(r"\D+", lines[2])[1])  # @@ -12,3 +12 @@
    changed = [f"{line[0]} {line[1:].strip()}" for line in lines[3:] if line[0] in "+-"]
    return Mutant(str(path.relative_to(ROOT)), at_line, "  ".join(changed), code)


def sample(folders: list[str], seed: int, count: int) -> tuple[int, list[Mutant]]:
    """How many places there are in these folders, and `count` mutants, each of another place."""
    drawn = random.Random(seed)  # noqa: S311
    found = []
    for path in sorted(
        {path for folder in folders for path in (ROOT / "fitctl" / folder).rglob("*.py")}
    ):
        module, grouped = places(path)
        found += [(path, module, mutations) for mutations in grouped]
    chosen = drawn.sample(found, min(count, len(found)))
    return len(found), [
        mutant_of(path, module, drawn.choice(mutations)) for path, module, mutations in chosen
    ]


class Copy:
    """A copy of the project, in which one worker mutates and tests."""

    _stamps = itertools.count(int(time.time()))

    def __init__(self, folder: Path):
        self.folder = folder
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],  # noqa: S607
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, folder / name)

    def write(self, name: str, code: str) -> None:
        """Put code in a module's place; Python goes by time and size when it looks for compiled code."""
        path = self.folder / name
        path.write_text(code)
        stamp = next(self._stamps)
        os.utime(path, (stamp, stamp))

    def test(self, tests: dict[str, float]) -> tuple[str, str]:
        """Run tests, with their limits in seconds, until one fails; returns the verdict and that test."""
        names = list(tests)
        for some in (names[:FIRST], names[FIRST:]):  # to collect all takes longer than a few tests
            verdict, by = self._run({test: tests[test] for test in some})
            if verdict != "survived":
                break
        return verdict, by

    def _run(self, tests: dict[str, float]) -> tuple[str, str]:
        if not tests:
            return "survived", ""
        chosen, current = (self.folder / f"chosen.{name}" for name in ("json", "current"))
        chosen.write_text(json.dumps(tests))
        current.unlink(missing_ok=True)
        files = dict.fromkeys(test.partition("::")[0] for test in tests)
        process = _PROCESSES.Process(
            target=run_forked, args=(self.folder, ["-x", "-q", f"--chosen={chosen}", *files])
        )
        process.start()
        process.join(LIMIT_S + sum(tests.values()))
        hangs = process.is_alive()
        with contextlib.suppress(ProcessLookupError):  # also what tests left behind, such as mocks
            os.killpg(process.pid or 0, signal.SIGKILL)
        process.join()
        if process.exitcode == 0:
            return "survived", ""
        said = (self.folder / "output").read_text(errors="replace")
        by = current.read_text() if current.exists() else said.strip().rpartition("\n")[2]
        return "timeout" if hangs or "+ Timeout +" in said else "killed", by


def measure(copy: Copy, workers: int, tests: Iterable[str] = TESTS) -> None:
    """Run tests without a mutant, and record in the copy's folder what :class:`Lines` reads."""
    config = copy.folder / "coveragerc"
    config.write_text(COVERAGE.format(folder=copy.folder))
    variables = {"PYTHONPATH": str(copy.folder), "COVERAGE_PROCESS_START": str(config)}
    options = ("-q", "-n", str(workers), "--timeout=900", f"--measure={copy.folder}")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *PLUGINS, *options, *tests],
        cwd=copy.folder,
        env={name: value for name, value in os.environ.items() if name != "CI"} | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout.strip().rpartition("\n")[2], flush=True)


class Lines:
    """Which tests execute each line, as :func:`measure` recorded it in a folder."""

    def __init__(self, folder: Path):
        reports = [json.loads(path.read_text()) for path in folder.glob("tests-*.json")]
        ran = {test: report for tests in reports for test, report in tests.items()}
        failing = sorted(test for test, report in ran.items() if not report["passed"])
        print("left out, since they fail without a mutant:", *failing or ["none"], flush=True)
        self.took_s = {test: ran[test]["took_s"] for test in ran if test not in failing}
        self._tests: dict[str, set[str]] = defaultdict(set)  # by context
        for test in self.took_s:
            for context in (test, *ran[test]["fixtures"]):
                self._tests[context].add(test)
        recorded = coverage.Coverage(config_file=str(folder / "coveragerc"))
        recorded.combine()
        data = recorded.get_data()
        self._contexts = {
            Path(name).relative_to(folder).as_posix(): data.contexts_by_lineno(name)
            for name in data.measured_files()
        }

    def _executing(self, path: str, lines: Iterable[int] | None = None) -> set[str]:
        """Tests that execute one of these lines of a module, or any of its lines."""
        by_line = self._contexts.get(path, {})
        contexts = {
            # Processes that tests start have PYTEST_CURRENT_TEST for a context.
            re.sub(r" \((setup|call|teardown)\)$", "", context)
            for line in (by_line if lines is None else lines)
            for context in by_line.get(line, ())
        }
        return set().union(*(self._tests[context] for context in contexts))

    def tests(self, path: str, line: int) -> dict[str, float]:
        """The tests for a mutant, fast and near ones first, each with its limit in seconds."""
        if lines := lines_of_statement((ROOT / path).read_text(), line):
            tests = self._executing(path, lines)
        else:
            folder = f"{Path(path).parent.as_posix()}/"
            within = (name for name in self._contexts if name.startswith(folder))
            tests = self._executing(path) or set().union(*map(self._executing, within))
        nearest = f"tests{Path(path).parent.as_posix().removeprefix('fitctl')}/"
        chosen = sorted(
            (test for test in self.took_s if test in tests),
            key=lambda test: (self.took_s[test] > SLOW_S, not test.startswith(nearest)),
        )
        return {test: LIMIT_S + LIMIT_RATIO * self.took_s[test] for test in chosen}


def lines_of_statement(code: str, line: int) -> Iterable[int]:
    """The lines of the innermost statement at a line, without its body; none outside functions."""
    around = [  # from the outermost on
        node
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0)
    ]
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    if not any(isinstance(node, functions) and line >= node.body[0].lineno for node in around):
        return ()
    body = getattr(around[-1], "body", None)
    end = body[0].lineno - 1 if body else around[-1].end_lineno or 0
    return range(around[-1].lineno, end + 1) if line <= end else (line,)


def try_mutant(copy: Copy, mutant: Mutant, tests: dict[str, float]) -> Outcome:
    """Run the tests that execute a mutant with it, and the test that fails again, with it and without."""
    started_s = time.monotonic()
    original = (ROOT / mutant.path).read_text()
    verdict, by = "survived", ""
    for _ in range(TRIES if tests else 0):
        copy.write(mutant.path, mutant.code)
        verdict, by = copy.test(tests)
        alone = {by: tests[by]} if by in tests else {}
        fails_again = not alone or copy.test(alone)[0] != "survived"
        copy.write(mutant.path, original)
        if not alone or (fails_again and copy.test(alone)[0] == "survived"):
            break
        verdict, by = "survived", ""
    took_s = time.monotonic() - started_s
    return Outcome(mutant, verdict, by, len(tests), took_s, os.getloadavg()[0])


def run(mutants: list[Mutant], workers: int) -> list[Outcome]:
    """Try every mutant, on `workers` copies of the project side by side."""
    waiting: queue.SimpleQueue[Mutant] = queue.SimpleQueue()
    for mutant in mutants:
        waiting.put(mutant)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="fitctl-mutants-") as folder:
        copies = [Copy(Path(folder) / str(number)) for number in range(workers)]
        measure(copies[0], workers)
        lines = Lines(copies[0].folder)

        def work(copy: Copy) -> None:
            while True:
                try:
                    mutant = waiting.get_nowait()
                except queue.Empty:
                    return
                outcome = try_mutant(copy, mutant, lines.tests(mutant.path, mutant.line))
                outcomes.append(outcome)
                print(
                    f"{len(outcomes)}/{len(mutants)} {outcome.verdict} in {outcome.took_s:.0f} s"
                    f" by {outcome.tests} tests {mutant.path}:{mutant.line} {mutant.diff}",
                    flush=True,
                )

        threads = [threading.Thread(target=work, args=(copy,)) for copy in copies]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return outcomes


def table(found: dict[str, Any]) -> str:
    """The figure and the table for the page."""
    rows = [
        "| room | mutants | killed | killed by a time limit | survived |",
        "| --- | --- | --- | --- | --- |",
    ]
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    for outcome in found["mutants"]:
        rooms[outcome["path"].split("/")[1]][outcome["verdict"]] += 1
    for room, counts in [*sorted(rooms.items()), ("all", sum(rooms.values(), Counter()))]:
        by_verdict = (counts[verdict] for verdict in ("killed", "timeout", "survived"))
        rows.append(f"| {room} | {' | '.join(map(str, (counts.total(), *by_verdict)))} |")
    killed, total = counts.total() - counts["survived"], counts.total()
    interval = binomtest(killed, total).proportion_ci(method="wilson")
    return "\n".join(
        (
            f"The tests killed {killed} of {total} mutants, **{killed / total:.1%}**, drawn with seed"
            f" {found['seed']} from {found['places']} places; 95 % interval for all places: {interval.low:.0%}"
            f" to {interval.high:.0%}.",
            "",
            *rows,
            "",
            f"*Machine: {os.cpu_count()} cores, Python {platform.python_version()}; date:"
            f" {found['started'][:10]}; median load {found['load']:.1f}; {found['took_s'] / 60:.0f} minutes.*",
        )
    )


def write_page(text: str) -> None:
    """Put the table into its place in the documentation."""
    begin, end = "<!-- mutants: begin -->\n", "<!-- mutants: end -->"
    before, _, rest = PAGE.read_text().partition(begin)
    PAGE.write_text(f"{before}{begin}{text}\n{end}{rest.partition(end)[2]}")


def main() -> None:
    """Draw, run, and print each survivor, the table and one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="folders below fitctl/")
    parser.add_argument(
        "--again",
        type=Path,
        help="output of an earlier run: keep what it found, and try only its survivors",
    )
    parser.add_argument("--page", action="store_true", help=f"write the table into {PAGE.name}")
    given = parser.parse_args()
    mutation_operators.append((libcst.Expr, delete_statement))

    started = datetime.datetime.now(datetime.UTC)
    population, mutants = sample(given.rooms, given.seed, given.count)
    print(f"seed {given.seed}: {len(mutants)} mutants of {population} places", flush=True)
    known = {}
    if given.again:
        earlier = json.loads(given.again.read_text().strip().rpartition("\n")[2])["mutants"]
        found_then = (outcome for outcome in earlier if outcome["verdict"] != "survived")
        known = {(one["path"], one["line"], one["diff"]): one for one in found_then}
    again = [mutant for mutant in mutants if mutant.place not in known]
    outcomes = [outcome.report() for outcome in run(again, given.workers)]
    outcomes += [known[mutant.place] for mutant in mutants if mutant.place in known]
    found = {
        "seed": given.seed,
        "places": population,
        "started": started.isoformat(timespec="seconds"),
        "took_s": round((datetime.datetime.now(datetime.UTC) - started).total_seconds()),
        "load": statistics.median(outcome["load"] for outcome in outcomes),
        "mutants": sorted(outcomes, key=lambda outcome: (outcome["path"], outcome["line"])),
    }
    print("\nsurvivors")
    for outcome in found["mutants"]:
        if outcome["verdict"] == "survived":
            print(f"{outcome['path']}:{outcome['line']}  {outcome['diff']}")
    text = table(found)
    print(f"\n{text}\n")
    if given.page:
        write_page(text)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
