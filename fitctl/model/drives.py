"""Test motions: what is added to the stages' commands in an experiment, as functions of time."""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Channel = Literal[
    "stack1", "stack2", "stack3", "fsm_az", "fsm_el", "siderostat_az", "siderostat_el"
]
STACKS: tuple[Channel, ...] = ("stack1", "stack2", "stack3")
FSM: tuple[Channel, ...] = ("fsm_az", "fsm_el")
SIDEROSTAT: tuple[Channel, ...] = ("siderostat_az", "siderostat_el")


class Drive(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One periodic motion of one channel; outside its time it adds nothing.

    Attributes
    ----------
    channel : str
        A stack (volts at the D/A about the bias), a mirror axis or a siderostat axis (pixels on the
        focal plane about where it was held).
    shape : str
        All shapes begin at zero, rising, and have this period's phase as their argument.
    amplitude, end_amplitude : float
        At the start and, by a straight line, at the end.
    frequency_hz, end_frequency_hz : float
        Likewise, by a straight line (a chirp) where they differ.
    start_s, duration_s : float
        From the experiment's start.
    """

    channel: Channel
    shape: Literal["triangle", "sine", "square"]
    amplitude: float
    frequency_hz: float
    duration_s: float
    start_s: float = 0.0
    end_amplitude: float | None = None
    end_frequency_hz: float | None = None


def standstill(duration_s: float) -> list[Drive]:
    """Nothing moves for a time: a motion of no amplitude."""
    return [
        Drive(
            channel="fsm_az", shape="sine", amplitude=0.0, frequency_hz=1.0, duration_s=duration_s
        )
    ]


def drive_value(drive: Drive, time_s: float) -> float:
    """What the drive adds at `time_s` from the experiment's start."""
    since_s = time_s - drive.start_s
    if not 0.0 <= since_s < drive.duration_s:
        return 0.0
    part = since_s / drive.duration_s
    end_hz = drive.frequency_hz if drive.end_frequency_hz is None else drive.end_frequency_hz
    end_amplitude = drive.amplitude if drive.end_amplitude is None else drive.end_amplitude
    cycles = since_s * (drive.frequency_hz + (end_hz - drive.frequency_hz) * part / 2)
    return (drive.amplitude + (end_amplitude - drive.amplitude) * part) * _SHAPES[drive.shape](
        cycles
    )


def _triangle(cycles: float) -> float:
    return 4 * abs((cycles + 0.75) % 1.0 - 0.5) - 1


def _sine(cycles: float) -> float:
    return math.sin(2 * math.pi * cycles)


def _square(cycles: float) -> float:
    return 1.0 if cycles % 1.0 < 0.5 else -1.0


_SHAPES = {"triangle": _triangle, "sine": _sine, "square": _square}


def experiment_s(drives: list[Drive]) -> float:
    """How long it takes until all drives have ended."""
    return max((drive.start_s + drive.duration_s for drive in drives), default=0.0)


def channel_values(drives: list[Drive], channels: tuple[Channel, ...], time_s: float) -> Floats:
    """What all drives add to some channels at `time_s`, shape (channels,)."""
    values = np.zeros(len(channels))
    for drive in drives:
        if drive.channel in channels:
            values[channels.index(drive.channel)] += drive_value(drive, time_s)
    return values
