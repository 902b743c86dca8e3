"""The piezo amplifier between ticks: what it measures, and whether that is what it was told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Mdt693Device
from fitctl.drivers.interface import DeviceMismatch, PiezoAmplifier
from fitctl.logging.records import PiezoReading

Floats = NDArray[np.float64]


def read_piezo(piezo: PiezoAmplifier, loop_name: str, clock: Clock) -> PiezoReading:
    """Ask for its voltages and its limit; takes as long as the wire does.

    Raises
    ------
    DeviceError
    """
    volts, limit_v = piezo.stack_volts(), piezo.limit_v()
    return PiezoReading(
        time_s=clock.now_s(),
        loop=loop_name,
        stack1_v=float(volts[0]),
        stack2_v=float(volts[1]),
        stack3_v=float(volts[2]),
        limit_v=limit_v,
    )


def disagreement(
    reading: PiezoReading, settings: Mdt693Device, lowest_v: Floats, highest_v: Floats
) -> DeviceMismatch | None:
    """What was measured, where it is not what the D/A was told since the last reading.

    Parameters
    ----------
    reading : PiezoReading
    settings : Mdt693Device
    lowest_v, highest_v : arrays, shape (3,)
        The range of what the D/A was told, at the D/A.

    Returns
    -------
    DeviceMismatch or None
        Of the first stack that is outside its range by more than `follow_tolerance_v`.
    """
    measured_v = (reading.stack1_v, reading.stack2_v, reading.stack3_v)
    told_v = np.clip(settings.gain * np.array([lowest_v, highest_v]), 0.0, settings.limit_v)
    tolerance_v = settings.follow_tolerance_v
    for stack, volts in enumerate(measured_v):
        low_v, high_v = told_v[:, stack]
        if not low_v - tolerance_v <= volts <= high_v + tolerance_v:
            return DeviceMismatch(
                "piezo amplifier",
                settings.port,
                f"stack {stack + 1} within {tolerance_v:g} V of the {low_v:.1f} to {high_v:.1f} V "
                "that the D/A was told",
                f"{volts:.1f} V",
                "check the cable from D/A to amplifier, the amplifier's own set-point (it must be 0 V), "
                "the stack, and piezo.gain in the rig file",
            )
    return None
