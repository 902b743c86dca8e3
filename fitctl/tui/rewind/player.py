"""The thread that makes moments of the past, the newest request first."""

from __future__ import annotations

import threading
from collections.abc import Callable

from fitctl.logging.errors import LogError
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.rewind.moment import Recording, state_of
from fitctl.tui.state import ConsoleState


class Player:
    """Makes the console's state at a time, on a thread of its own; only the newest of many requests counts.

    Parameters
    ----------
    recording : Recording
    on_state : callable
        Gets the time, and the state with its alarms, or why there is none. Called on the player's thread.
    """

    def __init__(
        self,
        recording: Recording,
        on_state: Callable[[float, tuple[ConsoleState, AlarmBook] | str], object],
    ) -> None:
        self.recording = recording
        self._on_state = on_state
        self._wanted_s: float | None = None
        self._change = threading.Condition()
        self._ended = False
        self._thread: threading.Thread | None = None

    def seek(self, time_s: float) -> None:
        """Ask for a time."""
        with self._change:
            self._wanted_s = time_s
            self._change.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="console-player", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread after its present request; a daemon, it does not delay the end of the process."""
        with self._change:
            self._ended = True
            self._change.notify()

    def _run(self) -> None:
        while True:
            with self._change:
                while self._wanted_s is None and not self._ended:
                    self._change.wait()
                if self._ended or self._wanted_s is None:
                    return
                time_s, self._wanted_s = self._wanted_s, None
            self._on_state(time_s, self._make(time_s))

    def _make(self, time_s: float) -> tuple[ConsoleState, AlarmBook] | str:
        try:
            moment = self.recording.at(time_s)
            return "no data had arrived by then" if moment is None else state_of(moment, time_s)
        except LogError as error:
            return str(error)
        except Exception as error:  # anyone may have written the log
            why = f"{type(error).__name__}: {error}".partition("\n")[0]
            return f"this moment cannot be shown: the recording has unexpected data ({why}); choose another"
