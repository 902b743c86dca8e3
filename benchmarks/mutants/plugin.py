"""pytest plugin of the mutation tests: measure which tests execute each line, and run chosen tests.

``--measure FOLDER``
    With coverage running in every process (``COVERAGE_PROCESS_START``), name its contexts after the tests. Each
    process writes a JSON file there: what each test took, whether it passed, and the shared fixtures it uses.
``--chosen FILE``
    Run the tests in a JSON object, in its order, each with its own time limit in seconds. ``FILE.current``
    names the test that runs.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NoReturn

import coverage
import pytest

# The tests marked long count too.
MARKED = "not slow and not peer and not fault and not miswired and not terminal and not dist"
PLUGINS = ("-p", "no:cacheprovider", "-p", __name__, "-m", MARKED)


def run_forked(folder: Path, arguments: list[str]) -> NoReturn:
    """Run pytest on the copy of the project in a folder, as the last act of a forked process."""
    os.setsid()
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = str(folder)
    os.environ.pop("CI", None)
    output = os.open("output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    status = pytest.main([*PLUGINS, *arguments])
    sys.stdout.flush()
    os._exit(status)  # waits for no thread that a mutant keeps from ending


def pytest_addoption(parser: pytest.Parser) -> None:
    """The two options."""
    parser.addoption("--measure", type=Path)
    parser.addoption("--chosen", type=Path)


def pytest_configure(config: pytest.Config) -> None:
    """Register what the options ask for."""
    for option, plugin in (("--measure", Measuring), ("--chosen", Chosen)):
        if path := config.getoption(option):
            config.pluginmanager.register(plugin(path))


class Measuring:
    """Contexts of the coverage data, and how each test went."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._took_s: dict[str, float] = {}
        self._failed: set[str] = set()
        self._fixtures: set[tuple[str, str]] = set()

    @contextlib.contextmanager
    def _recorded_as(self, context: str) -> Iterator[None]:
        """Lines executed meanwhile count for this context."""
        before = coverage.Coverage.current().switch_context(context)
        try:
            yield
        finally:
            coverage.Coverage.current().switch_context(before or "")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        """Record a test under its own name."""
        started_s, tracer = time.perf_counter(), sys.gettrace()
        with self._recorded_as(item.nodeid):
            done = yield
        sys.settrace(tracer)  # a test may have used it for itself, which ends the coverage
        self._took_s[item.nodeid] = time.perf_counter() - started_s
        return done

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
        """A fixture of several tests runs for all of them, not only for the first."""
        if fixturedef.scope == "function":
            return (yield)
        self._fixtures.add((fixturedef.baseid, fixturedef.argname))
        with self._recorded_as(f"{fixturedef.baseid}::{fixturedef.argname}"):
            return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep what failed."""
        if report.failed:
            self._failed.add(report.nodeid)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the file."""
        running = coverage.Coverage.current()
        running.stop()
        running.save()
        names = {item.nodeid: getattr(item, "fixturenames", []) for item in session.items}
        tests = {
            test: {
                "took_s": took_s,
                "passed": test not in self._failed,
                "fixtures": [
                    f"{base}::{name}"
                    for base, name in self._fixtures
                    if name in names[test] and test.startswith(base)
                ],
            }
            for test, took_s in self._took_s.items()
        }
        (self._folder / f"tests-{os.getpid()}.json").write_text(json.dumps(tests))


class Chosen:
    """Which tests run, in which order and for how long."""

    def __init__(self, path: Path):
        self._limits_s: dict[str, float] = json.loads(path.read_text())
        self._current = path.with_suffix(".current")

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Choose, order and limit."""
        order = {test: number for number, test in enumerate(self._limits_s)}
        items[:] = sorted(
            (item for item in items if item.nodeid in order), key=lambda item: order[item.nodeid]
        )
        for item in items:
            # The other method waits for what the test leaves behind, which may never end.
            limit = pytest.mark.timeout(self._limits_s[item.nodeid], method="thread")
            item.add_marker(limit, append=False)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Name the test that starts."""
        self._current.write_text(nodeid)
