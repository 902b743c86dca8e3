"""Python imports this by itself when its folder is on the path: time.time() is what a file says, from now on.

The machine's own clock cannot be set by a test. What is stepped is therefore the clock of one process and of
those that it starts, as they read it by :func:`time.time`.
"""

import os
import time
from pathlib import Path

_FILE = Path(os.environ["FITCTL_TEST_CLOCK"])
_true = time.time


def _stepped():
    try:
        return _true() + float(_FILE.read_text())
    except (OSError, ValueError):
        return _true()


time.time = _stepped
