"""Other fitctl commands, run for the operator as processes of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

END_WAIT_S = 3.0
MOST_BYTES = 200_000
MOST_JSON_BYTES = 8_000_000
_ASKS = ": "  # at the end of a question
GENTLY = ("nice", "-n", "10")  # a rehearsal or a report takes no time from the instrument
_SHORT = {("sequence", "list"), ("check",)}  # which a person waits for, and which are soon over


class Job:
    """``fitctl ARGUMENTS`` as a child, whose output goes to a file without a name.

    So nobody has to read it in time, and the child goes on undisturbed when the console is left.

    Parameters
    ----------
    arguments : sequence of str
    outlives : bool
        It goes on when the console is left; otherwise :meth:`end` ends it.
    asks : bool
        It moves the stages, asks before it does, and ends with the console; :meth:`answer` answers it.
    """

    def __init__(
        self, arguments: Sequence[str], *, outlives: bool = False, asks: bool = False
    ) -> None:
        self.command_line = " ".join(["fitctl", *arguments])
        self.outlives, self.asks = outlives, asks
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  # closed by end()
        is_short = any(tuple(arguments[: len(words)]) == words for words in _SHORT)
        own = ["--console-pid", str(os.getpid())] if asks else []
        self._process = subprocess.Popen(
            [
                *([] if self.moves or is_short else GENTLY),
                sys.executable,
                "-m",
                "fitctl",
                *arguments,
                *own,
            ],
            stdin=subprocess.PIPE if asks else subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            bufsize=0,  # an answer that came too late is not kept for close()
        )

    @property
    def moves(self) -> bool:
        """Whether it moves the stages."""
        return self.outlives or self.asks

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    def text(self, most_bytes: int = MOST_BYTES) -> str:
        """What it has printed so far; of more than `most_bytes`, the end."""
        # Both have one place in the file: a read that moved it would have the child write over what it wrote.
        size = os.fstat(self._output.fileno()).st_size
        read = os.pread(self._output.fileno(), most_bytes, max(0, size - most_bytes))
        return read.decode(errors="replace")

    def question(self) -> str:
        """What it has asked and waits for: a line that it has not ended. Empty without one."""
        if not self.asks or self.status is not None:
            return ""
        line = self.text().rpartition("\n")[2]
        return line if line.endswith(_ASKS) else ""

    def answer(self, text: str) -> None:
        """Answer its question; nothing if it has ended meanwhile."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.write(f"{text}\n".encode())

    def interrupt(self) -> None:
        """Have it stop what it moves and end, as Ctrl-C does on a terminal."""
        if self.status is None:
            self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Ask it to end, and insist; nothing if it has, or if it outlives the console.

        One that moves the stages takes the time that it needs to bring them to a stand.
        """
        if self.status is None and not self.outlives:
            self._process.terminate()
            try:
                self._process.wait(END_WAIT_S)
            except subprocess.TimeoutExpired:
                if not self.asks:
                    self._process.kill()
                    self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._output.close()


def printed_json(job: Job) -> Any:
    """The JSON document that a job has printed.

    Raises
    ------
    ValueError
        If it has printed something else, or too much.
    """
    try:
        return json.loads(job.text(MOST_JSON_BYTES))
    except ValueError as error:
        msg = (
            f"{job.command_line}: cannot be shown: expected a JSON document of at most "
            f"{MOST_JSON_BYTES // 1_000_000} MB, got something else ({error}); run it in a terminal"
        )
        raise ValueError(msg) from None
