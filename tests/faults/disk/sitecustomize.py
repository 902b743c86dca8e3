"""Python imports this by itself when its folder is on the path: no disk tells its room while a file is there.

The disk of a network hangs so, in the kernel. That needs a file system of one's own; what is held is therefore
:func:`shutil.disk_usage` of one process and of those that it starts.
"""

import os
import shutil
import time
from pathlib import Path

_SILENT = Path(os.environ["FITCTL_TEST_SILENT_DISK"])
_true = shutil.disk_usage


def _held(path):
    while _SILENT.exists():
        time.sleep(0.05)
    return _true(path)


shutil.disk_usage = _held
