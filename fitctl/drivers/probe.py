"""What `fitctl doctor` reads from a device without setting anything."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

from fitctl.drivers.interface import DeviceIdentity


class Probe(NamedTuple):
    """What a device reports; nothing was set, nothing moved.

    Attributes
    ----------
    identity : DeviceIdentity
    round_trip_s : float
        Median of a few questions.
    disagreements : tuple of str
        What differs from the rig file, and what to do about it; one line each.
    """

    identity: DeviceIdentity
    round_trip_s: float
    disagreements: tuple[str, ...] = ()


def round_trip_s(ask: Callable[[], object], questions: int = 5) -> float:
    """Median time of a question and its answer."""
    times_s = []
    for _ in range(questions):
        started_s = time.monotonic()
        ask()
        times_s.append(time.monotonic() - started_s)
    return statistics.median(times_s)
