"""Running instruments for the catalogue, each started once, and where results are written."""

import json
import os
import time
from pathlib import Path

import pytest

from .setups import started

RESULTS = {}


@pytest.fixture(scope="module")
def rig(request, tmp_path_factory):
    """The running rig of a name; all entries of it follow each other."""
    with started(request.param, tmp_path_factory.mktemp("faults"), RESULTS) as rig:
        yield rig


def pytest_runtest_logfinish():
    """Add what was measured to the file that FITCTL_FAULT_RESULTS names, entry by entry."""
    path = os.environ.get("FITCTL_FAULT_RESULTS")
    if not path or not RESULTS:
        return
    file = Path(path)
    RESULTS["run"] = {
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "load": round(os.getloadavg()[2], 1),
        "cores": os.cpu_count(),
    }
    before = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps(before | RESULTS, indent=1) + "\n")
