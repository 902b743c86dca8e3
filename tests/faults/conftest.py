"""Running instruments for the catalogue, each started once, and where results are written."""

import json
import os
from contextlib import ExitStack
from pathlib import Path

import pytest

from .setups import start

RESULTS = {}


@pytest.fixture(scope="module")
def rig(request, tmp_path_factory):
    """The running rig of a name; all entries of it follow each other."""
    with ExitStack() as stack:
        yield start(stack, request.param, tmp_path_factory.mktemp("faults"))


def pytest_sessionfinish():
    """Leave what was measured where FITCTL_FAULT_RESULTS says."""
    path = os.environ.get("FITCTL_FAULT_RESULTS")
    if path and RESULTS:
        Path(path).write_text(json.dumps(RESULTS, indent=1) + "\n")
