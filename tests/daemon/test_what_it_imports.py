"""What a supervisor imports at its start: libraries for designs and pictures would hold its memory."""

import subprocess
import sys

import pytest

NOT_FOR_THE_LOOP = {"control", "matplotlib", "numba", "rich", "scipy", "textual"}


@pytest.mark.long
def test_a_supervisor_imports_no_library_of_designs_and_pictures():
    code = "import sys, fitctl.daemon.run; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )

    assert NOT_FOR_THE_LOOP & set(done.stdout.split()) == set()
