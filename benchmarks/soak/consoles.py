"""A real console on a terminal of its own, which somebody reads."""

from __future__ import annotations

import contextlib
import os
import pty
import subprocess
import sys
import termios
import threading
from collections.abc import Sequence

_ROWS, _COLUMNS = 40, 140
_END_S = 10.0


class Console:
    """``fitctl console`` on a pseudo-terminal.

    Parameters
    ----------
    arguments : sequence of str
        That say which rig.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self._terminal, inside = pty.openpty()
        termios.tcsetwinsize(inside, (_ROWS, _COLUMNS))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fitctl", "console", *arguments],
            stdin=inside,
            stdout=inside,
            stderr=inside,
            start_new_session=True,
            env=os.environ | {"TERM": "xterm-256color"},
        )
        os.close(inside)
        threading.Thread(target=self._read, name="terminal", daemon=True).start()

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """It has not ended."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End it as a closed laptop does."""
        self._process.kill()
        self._process.wait(_END_S)

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the other end is closed: the console has ended
            while os.read(self._terminal, 65536):
                pass
        os.close(self._terminal)
