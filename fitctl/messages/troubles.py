"""What is not well with an instrument, read off one telemetry message: for shells and for metrics."""

from __future__ import annotations

from fitctl.messages.modes import Mode
from fitctl.messages.telemetry import Telemetry

RECORDER_SILENT_S = 10.0  # it reports about once a second


def troubles(telemetry: Telemetry) -> list[str]:
    """What an operator should look at, one line each; empty where all is well.

    A loop that is SAFE, an interlock that is tripped, a device in fault, a recorder that says nothing,
    records that are missing from the log.
    """
    found = []
    for loop in telemetry.loops:
        if loop.mode == Mode.SAFE.name:
            why = "" if loop.last_change is None else f": {loop.last_change.reason}"
            found.append(f"{loop.name} is SAFE{why}")
        found += [f"{loop.name} interlock {row.name}: {row.reason}" for row in loop.interlocks]
    found += [
        f"{device.device} at {device.endpoint}: {device.detail}"
        for device in telemetry.devices
        if device.state == "fault"
    ]
    found += _of_recording(telemetry)
    return found


def _of_recording(telemetry: Telemetry) -> list[str]:
    found = []
    recorder = telemetry.recorder
    if recorder is None:
        found.append("nothing is recorded yet; if this stays, look at the supervisor's events")
    elif telemetry.time_s - recorder.time_s > RECORDER_SILENT_S:
        silent_s = telemetry.time_s - recorder.time_s
        found.append(f"the recorder has said nothing for {silent_s:.0f} s")
    if telemetry.records_lost:
        found.append(f"{telemetry.records_lost} records are missing from the log of this run")
    return found
