"""Other fitctl commands, run for the operator as processes of their own."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence

END_WAIT_S = 3.0
MOST_BYTES = 200_000
GENTLY = ("nice", "-n", "10")  # a rehearsal or a report takes no time from the instrument


class Job:
    """``fitctl ARGUMENTS`` as a child, whose output goes to a file without a name.

    So nobody has to read it in time, and the child goes on undisturbed when the console is left.

    Parameters
    ----------
    arguments : sequence of str
    outlives : bool
        It goes on when the console is left; otherwise :meth:`end` ends it.
    """

    def __init__(self, arguments: Sequence[str], *, outlives: bool = False) -> None:
        self.command_line = " ".join(["fitctl", *arguments])
        self.outlives = outlives
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  # closed by end()
        self._process = subprocess.Popen(
            [*([] if outlives else GENTLY), sys.executable, "-m", "fitctl", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    def text(self) -> str:
        """What it has printed so far; of very much, the end."""
        size = self._output.seek(0, 2)
        self._output.seek(max(0, size - MOST_BYTES))
        return self._output.read().decode(errors="replace")

    def end(self) -> None:
        """Ask it to end, and insist; nothing if it has, or if it outlives the console."""
        if self.status is None and not self.outlives:
            self._process.terminate()
            try:
                self._process.wait(END_WAIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._output.close()
