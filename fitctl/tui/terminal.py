"""The console's terminal: Textual's driver, also where the process is stopped without notice."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from textual.drivers.linux_driver import LinuxDriver


class TerminalDriver(LinuxDriver):
    """Textual's driver, which a process that was stopped by SIGSTOP continues with no threads too many.

    Textual starts its threads at every SIGCONT, and ends those that it had only at SIGTSTP. SIGSTOP cannot be
    handled: each SIGCONT after it would leave one more thread that reads keys (so that they share the
    terminal's bytes) and one that writes, and the terminal would be left in raw mode when the console ends.

    Textual also writes to the terminal in the signal's handler. A signal that comes while the main thread puts
    a frame into the queue of what is to be written would wait for ever for that queue's lock, so here both
    signals wait for the event loop.
    """

    _in_application_mode = False
    _was_left = False

    def start_application_mode(self) -> None:
        """Set the terminal up, read keys, and draw what was there; leave first what was never left."""
        if self._in_application_mode:
            self.suspend_application_mode()
        super().start_application_mode()
        self._in_application_mode = True
        if self._was_left:
            self._app.call_later(self._app.refresh, layout=True)

    def stop_application_mode(self) -> None:
        """Stop reading keys, and leave the terminal as it was."""
        super().stop_application_mode()
        self._in_application_mode, self._was_left = False, True

    def _sigtstp_application(self, *_: object) -> None:
        self._soon(super()._sigtstp_application)

    def _sigcont_application(self, *_: object) -> None:
        self._soon(super()._sigcont_application)

    def _soon(self, handler: Callable[[], None]) -> None:
        with suppress(RuntimeError):  # the loop has ended, and so does the console
            self._loop.call_soon_threadsafe(handler)
