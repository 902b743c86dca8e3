"""What a supervisor and its loops report: records, events, and devices that failed."""

from __future__ import annotations

from collections.abc import Callable

from fitctl.clock import Clock
from fitctl.drivers.interface import DeviceError
from fitctl.logging.records import AnyRecord, DeviceFailure, Event, FailingDevice, Severity

NO_MISTAKE = "no error inside fitctl"
"""What is expected, in the text of every error that neither a device nor an input can cause."""


def error_text(error: BaseException, *known: type[Exception]) -> str:
    """The error's own words for a device's error, or a `known` type; any other is a mistake in fitctl."""
    if isinstance(error, (DeviceError, *known)):
        return str(error)
    return f"expected {NO_MISTAKE}, got {error!r}; report it with the log"


class Journal:
    """Writes dated records; for the supervisor's main thread.

    Parameters
    ----------
    clock : Clock
    record : callable
        Takes every record; must not block.
    """

    def __init__(self, clock: Clock, record: Callable[[AnyRecord], None]) -> None:
        self.clock = clock
        self.record = record

    def event(self, severity: Severity, source: str, message: str) -> None:
        """Record something that an operator should read."""
        self.record(
            Event(time_s=self.clock.now_s(), severity=severity, source=source, message=message)
        )

    def failure(self, loop_name: str, device: FailingDevice, error: BaseException) -> None:
        """Record that a device failed while it was used."""
        self.record(
            DeviceFailure(
                time_s=self.clock.now_s(),
                loop=loop_name,
                device=device,
                kind=type(error).__name__,
                error=error_text(error),
            )
        )
