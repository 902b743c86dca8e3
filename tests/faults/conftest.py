"""Running instruments for the catalogue, each started once, and where results are written."""

import json
import os
import time
from pathlib import Path

import pytest

from .setups import started

RESULTS = {}
"""What was measured since the last report of a test."""
BEGUN_S = time.monotonic()
RUN = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
"""Which run of several this is, by when it began."""


@pytest.fixture(scope="module")
def rig(request, tmp_path_factory):
    """A running instrument, by its rig and its table; all entries of it follow each other."""
    name, table = request.param
    with started(name, tmp_path_factory.mktemp("faults")) as rig:
        yield rig
    RESULTS[f"records: {name}, {table}"] = rig.records


def pytest_runtest_makereport(item):
    """Reports carry what was measured: a worker's, too, come to the process that writes the file."""
    item.user_properties += RESULTS.items()
    RESULTS.clear()


def pytest_runtest_logreport(report):
    """Add what was measured to the file that FITCTL_FAULT_RESULTS names, entry by entry.

    What earlier runs found stays where this one finds nothing, and so does what is known of such a run.
    """
    path = os.environ.get("FITCTL_FAULT_RESULTS")
    if not path or report.when != "teardown" or "PYTEST_XDIST_WORKER" in os.environ:
        return
    file = Path(path)
    results = json.loads(file.read_text()) if file.exists() else {}
    runs = results.pop("runs", {}) | {RUN: run_so_far()}
    results |= {name: result | {"run": RUN} for name, result in report.user_properties}
    known = {result["run"] for result in results.values()}
    results["runs"] = {begun: run for begun, run in runs.items() if begun in known}
    file.write_text(json.dumps(results, indent=1) + "\n")


def run_so_far():
    """What this run took, on which machine."""
    return {
        "load": round(os.getloadavg()[2], 1),
        "cores": os.cpu_count(),
        "took_min": round((time.monotonic() - BEGUN_S) / 60, 1),
    }
