"""How a device's error reads in an event, and its record in the log."""

from __future__ import annotations

from fitctl.drivers.interface import DeviceError
from fitctl.logging.records import DeviceFailure, FailingDevice


def error_text(error: BaseException) -> str:
    """The error's own words for a device's error; with its type for any other."""
    return str(error) if isinstance(error, DeviceError) else repr(error)


def failure_record(
    now_s: float, loop_name: str, device: FailingDevice, error: BaseException
) -> DeviceFailure:
    """The log's record of a device that failed."""
    return DeviceFailure(
        time_s=now_s,
        loop=loop_name,
        device=device,
        kind=type(error).__name__,
        error=error_text(error),
    )
