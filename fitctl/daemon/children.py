"""Processes beside the supervisor, started again when they die: the recorder, the metrics, the gateway."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from fitctl.logging.records import Severity
from fitctl.processes import end_process, last_line, start_process

END_S = 5.0
_WELL_S = 10.0  # one that lived this long is started again at once
PATIENCE_S = 60.0


class Child:
    """A fitctl process, started again when it dies: at once, then ever more patiently.

    Parameters
    ----------
    name : str
        What people call it.
    arguments : sequence of str
        ``fitctl`` arguments that start it.
    errors : Path
        Where its error output goes; removed at the end.
    again : str
        What starting it again means, for people.
    note : callable
        Takes events.
    patience_s : float
        The longest wait before it is started again, when it dies again and again.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        errors: Path,
        again: str,
        note: Callable[[Severity, str, str], None],
        patience_s: float = PATIENCE_S,
    ) -> None:
        self.name = name
        self._arguments = arguments
        self._errors = errors
        self._again = again
        self._note = note
        self._most_patience_s = patience_s
        self._patience_s = 0.0
        self._again_s = math.inf
        self._start()

    def check(self) -> None:
        """Start it again if it has died and its time has come; called about once a second."""
        now_s = time.monotonic()
        code = self._process.poll()
        if code is None:
            if now_s - self._started_s > _WELL_S:
                self._patience_s = 0.0
        elif self._again_s == math.inf:
            how = f"was killed by signal {-code}" if code < 0 else f"ended with status {code}"
            if code == -signal.SIGALRM:
                how = "hung"  # and had said beforehand that it is to be ended then
            why = last_line(self._errors)
            self._again_s = now_s + self._patience_s
            self._note(
                "error",
                self.name,
                f"the {self.name} {how}{': ' + why if why else ''}; {self._again}"
                + (f" in {self._patience_s:.0f} s" if self._patience_s else ""),
            )
            self._patience_s = min(max(1.0, 2 * self._patience_s), self._most_patience_s)
        if now_s >= self._again_s:
            try:
                self._start()
            except OSError as error:
                self._again_s = now_s + max(1.0, self._patience_s)
                self._note(
                    "error",
                    self.name,
                    f"the {self.name} cannot be started: {error}; again in {max(1.0, self._patience_s):.0f} s",
                )
                self._patience_s = min(max(1.0, 2 * self._patience_s), self._most_patience_s)

    @property
    def running(self) -> bool:
        """It was started and has not ended."""
        return self._process.poll() is None

    @property
    def started_s(self) -> float | None:
        """When the process that runs now was started, by the monotonic clock; None if it has ended."""
        return self._started_s if self.running else None

    def ask_to_end(self) -> None:
        """Tell it to end, without waiting for it."""
        self._process.terminate()

    def end(self, timeout_s: float = END_S) -> None:
        """Let it write what it has and end; it is killed if it does not within the time."""
        end_process(self._process, timeout_s)
        self._errors.unlink(missing_ok=True)

    def _start(self) -> None:
        with self._errors.open("wb") as errors:
            self._process = start_process(self._arguments, stderr=errors)
        self._started_s = time.monotonic()
        self._again_s = math.inf
