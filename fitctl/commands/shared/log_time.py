"""Times in a log, as options give them."""

from __future__ import annotations

from datetime import UTC, datetime

from fitctl.config import ConfigError
from fitctl.logging.reading import LogInfo

_NS_PER_S = 1_000_000_000


def time_ns(option: str, text: str, found: LogInfo) -> int:
    """Nanoseconds since 1970, of seconds after the log's start or of a UTC time.

    Raises
    ------
    ConfigError
        If it is neither.
    """
    try:
        seconds = found.start_s + float(text)
    except ValueError:
        try:
            when = datetime.fromisoformat(text)
        except ValueError:
            msg = f"{option} {text}: expected seconds, or UTC such as 2026-11-21T09:18:30"
            raise ConfigError(msg) from None
        seconds = (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    try:
        return round(seconds * _NS_PER_S)
    except (ValueError, OverflowError):
        msg = f"{option} {text}: is no time in {found.path}, which has {sum(found.counts.values())} records"
        raise ConfigError(msg) from None
