"""Mutation testing: change the code in one place, and see whether the tests of its room fail.

mutmut makes the mutants; this module draws a random sample of them and runs the tests. mutmut itself can
neither draw a sample nor run other tests for each room. Its operators do not delete statements; the one added
here does.

Each worker has a copy of the project in a temporary folder and mutates one module there at a time. Every place
in the code is as likely as any other, however many mutants mutmut makes of it. Strings with a space are texts
for people and stay as they are, and mutmut leaves decorated functions alone.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import difflib
import itertools
import json
import os
import platform
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import libcst
from mutmut.mutation import file_mutation
from mutmut.mutation.mutators import mutation_operators

ROOT = Path(__file__).parents[1]
_LOOP_TESTS = ("tests/loop", "tests/stages", "tests/supervisor", "tests/simulation")
_AMPLIFIERS = "tests/drivers/test_servo_amplifier_contract.py"
# Where code is mutated, below fitctl/, and the tests that run for it, as patterns of files and folders.
TESTS = {
    "controllers": ("tests/controllers",),
    "loop": _LOOP_TESTS,
    "stages": ("tests/stages", *_LOOP_TESTS),
    "supervisor": ("tests/supervisor", *_LOOP_TESTS),
    "logging": ("tests/logging", "tests/**/test_cli_log.py"),
    "drivers": ("tests/drivers", "tests/mocks"),
    "drivers/bal_analog": ("tests/drivers/bal_analog", _AMPLIFIERS, "tests/mocks/bal_analog"),
    "drivers/c887": ("tests/drivers/c887", "tests/mocks/c887"),
    "drivers/cia402": ("tests/drivers/cia402", _AMPLIFIERS, "tests/mocks/cia402"),
    "drivers/ensemble": ("tests/drivers/ensemble", _AMPLIFIERS, "tests/mocks/ensemble"),
    "drivers/gige": ("tests/drivers/gige", "tests/mocks/gige"),
    "drivers/labjack_t7": (
        "tests/drivers/labjack_t7",
        "tests/drivers/test_modbus_link.py",
        "tests/mocks/labjack_t7",
    ),
    "drivers/mdt693": ("tests/drivers/mdt693", "tests/mocks/mdt693"),
    "drivers/modbus_dac": (
        "tests/drivers/modbus_dac",
        "tests/mocks/modbus",
        "tests/mocks/modbus_dac",
    ),
}
# A mutant that makes the tests this many times slower, and by half a minute, has stopped them.
LIMIT_FACTOR, LIMIT_S = 3.0, 30.0
# A test that fails once may have failed by chance; one that fails twice has found the mutant.
TRIES = 3


@dataclass(frozen=True)
class Mutant:
    """One changed place; `line` counts from 1."""

    room: str
    path: str
    line: int
    code: str
    diff: str


@dataclass(frozen=True)
class Outcome:
    """What the tests made of a mutant: killed, timeout or survived; `by` is the test that failed."""

    mutant: Mutant
    verdict: str
    by: str
    took_s: float


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


def mutant_of(
    room: str, path: Path, module: libcst.Module, mutation: file_mutation.Mutation
) -> Mutant:
    """The module's code with this mutation, and what differs."""
    code = module.deep_replace(mutation.original_node, mutation.mutated_node).code
    lines = list(
        difflib.unified_diff(module.code.splitlines(), code.splitlines(), lineterm="", n=0)
    )
    at_line = int(re.split(r"\D+", lines[2])[1])  # @@ -12,3 +12 @@
    changed = [f"{line[0]} {line[1:].strip()}" for line in lines[3:] if line[0] in "+-"]
    return Mutant(room, str(path.relative_to(ROOT)), at_line, code, "  ".join(changed))


def room_of(path: Path) -> str:
    """The longest name in `TESTS` under which a module lies."""
    name = path.relative_to(ROOT / "fitctl").as_posix()
    return max((room for room in TESTS if name.startswith(f"{room}/")), key=len)


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
        mutant_of(room_of(path), path, module, drawn.choice(mutations))
        for path, module, mutations in chosen
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

    def test(self, tests: tuple[str, ...], limit_s: float) -> tuple[int | None, str]:
        """Run tests until one fails; returns pytest's status (None after the limit) and that test."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        for name in ("CI", "PYTHONDONTWRITEBYTECODE"):
            environment.pop(name, None)
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            said, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            return None, ""
        finally:
            _end_session(process)
        failed = re.findall(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", said, re.MULTILINE)
        return process.returncode, failed[0] if failed else said.strip().rpartition("\n")[2]


def _end_session(process: subprocess.Popen[str]) -> None:
    """End what tests left behind, such as mocks of a supervisor that the mutant kept from ending."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def ordered(tests: tuple[str, ...], path: str) -> tuple[str, ...]:
    """The tests as files, those first whose name has the module's.

    pytest given a file and the folder in which it lies runs the file only.
    """
    found = [
        file
        for name in tests
        for file in (
            [ROOT / name] if name.endswith(".py") else sorted((ROOT / name).rglob("test_*.py"))
        )
    ]
    found.sort(key=lambda file: Path(path).stem not in file.name)
    return tuple(dict.fromkeys(str(file.relative_to(ROOT)) for file in found))


def try_mutant(copy: Copy, mutant: Mutant, limit_s: float) -> Outcome:
    """Run the tests of a mutant's room with it."""
    original = (ROOT / mutant.path).read_text()
    copy.write(mutant.path, mutant.code)
    started_s = time.monotonic()
    verdict, by = "survived", ""
    try:
        for _ in range(TRIES):
            status, by = copy.test(ordered(TESTS[mutant.room], mutant.path), limit_s)
            if status is None:
                verdict = "timeout"
                break
            if status == 0:
                break
            if "::" not in by or copy.test((by,), limit_s)[0] != 0:
                verdict = "killed"
                break
    finally:
        copy.write(mutant.path, original)
    return Outcome(mutant, verdict, by, time.monotonic() - started_s)


def limits_s(copy: Copy, rooms: list[str]) -> dict[str, float]:
    """How long each room's tests may take; ends the program if they fail without a mutant."""
    limits = {}
    for room in rooms:
        tests = ordered(TESTS[room], "")
        for _ in range(TRIES):
            started_s = time.monotonic()
            status, by = copy.test(tests, 1800.0)
            if status == 0:
                break
        else:
            said = by or "not done in 1800 s"
            raise SystemExit(f"the tests of {room} fail without a mutant, {TRIES} times: {said}")
        took_s = time.monotonic() - started_s
        limits[room] = LIMIT_FACTOR * took_s + LIMIT_S
        print(f"{room}: {took_s:.0f} s without a mutant", flush=True)
    return limits


def run(mutants: list[Mutant], workers: int) -> list[Outcome]:
    """Try every mutant, on `workers` copies of the project side by side."""
    waiting: queue.SimpleQueue[Mutant] = queue.SimpleQueue()
    for mutant in mutants:
        waiting.put(mutant)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="fitctl-mutants-") as folder:
        copies = [Copy(Path(folder) / str(number)) for number in range(workers)]
        limits = limits_s(copies[0], sorted({mutant.room for mutant in mutants}))

        def work(copy: Copy) -> None:
            while True:
                try:
                    mutant = waiting.get_nowait()
                except queue.Empty:
                    return
                outcome = try_mutant(copy, mutant, limits[mutant.room])
                outcomes.append(outcome)
                print(
                    f"{len(outcomes)}/{len(mutants)} {outcome.verdict} in {outcome.took_s:.0f} s"
                    f" {mutant.path}:{mutant.line} {mutant.diff}",
                    flush=True,
                )

        threads = [threading.Thread(target=work, args=(copy,)) for copy in copies]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return outcomes


def main() -> None:
    """Draw, run, and print each survivor and one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    folders = sorted({room.partition("/")[0] for room in TESTS})
    parser.add_argument(
        "--rooms", nargs="+", default=folders, help="folders of fitctl/, or modules' folders"
    )
    given = parser.parse_args()
    mutation_operators.append((libcst.Expr, delete_statement))

    started = datetime.datetime.now(datetime.UTC)
    population, mutants = sample(given.rooms, given.seed, given.count)
    print(f"seed {given.seed}: {len(mutants)} mutants of {population} places", flush=True)
    outcomes = run(mutants, given.workers)

    survivors = [outcome.mutant for outcome in outcomes if outcome.verdict == "survived"]
    print("\nsurvivors")
    for mutant in sorted(survivors, key=lambda mutant: (mutant.path, mutant.line)):
        print(f"{mutant.path}:{mutant.line}  {mutant.diff}")
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    by_room: dict[str, Counter[str]] = {}
    for outcome in outcomes:
        by_room.setdefault(outcome.mutant.room, Counter())[outcome.verdict] += 1
    print(
        json.dumps(
            {
                "seed": given.seed,
                "count": len(outcomes),
                "places": population,
                "killed": verdicts["killed"],
                "timeout": verdicts["timeout"],
                "survived": verdicts["survived"],
                "found_fraction": round(1.0 - verdicts["survived"] / max(1, len(outcomes)), 3),
                "rooms": {room: dict(counts) for room, counts in sorted(by_room.items())},
                "started": started.isoformat(timespec="seconds"),
                "took_s": round((datetime.datetime.now(datetime.UTC) - started).total_seconds()),
                "python": platform.python_version(),
                "cpus": os.cpu_count(),
                "survivors": [
                    {"path": mutant.path, "line": mutant.line, "diff": mutant.diff}
                    for mutant in survivors
                ],
                "killed_by": {
                    f"{outcome.mutant.path}:{outcome.mutant.line}": outcome.by
                    for outcome in outcomes
                    if outcome.verdict == "killed"
                },
            }
        )
    )


if __name__ == "__main__":
    main()
