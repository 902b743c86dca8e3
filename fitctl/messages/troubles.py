"""What is not well with an instrument, read off one telemetry message: for shells and for metrics."""

from __future__ import annotations

from fitctl.messages.modes import Mode
from fitctl.messages.telemetry import LoopState, Telemetry, TrippedInterlock

FIND_STAR = "check shutter and clouds; hold, stop or another acquire ends the search"
RECORDER_SILENT_S = 10.0  # it reports about once a second


def troubles(telemetry: Telemetry) -> list[str]:
    """What an operator should look at, one line each; empty where all is well.

    A loop that is SAFE or searches for the star that it lost, an interlock that is tripped, a device in fault,
    a recorder that says nothing, records that are missing from the log.
    """
    found = []
    for loop in telemetry.loops:
        if loop.mode == Mode.SAFE.name:
            why = "" if loop.last_change is None else f": {loop.last_change.reason}"
            found.append(f"{loop.name} is SAFE{why}")
        if loop.search_again is not None:
            found.append(f"{loop.name}: {search_again_text(loop, telemetry.time_s)}; {FIND_STAR}")
        found += [
            f"{loop.name} interlock {row.name}: {row.reason}" for row in alarming_interlocks(loop)
        ]
    found += [
        f"{device.device} at {device.endpoint}: {device.detail}"
        for device in telemetry.devices
        if device.state == "fault"
    ]
    found += _of_recording(telemetry)
    return found


def search_again_text(loop: LoopState, now_s: float) -> str:
    """Since when the star is lost, and how far the search goes; empty if the loop does not search again."""
    search = loop.search_again
    if search is None:
        return ""
    return (
        f"star lost {now_s - search.since_s:.0f} s ago; the loop searches again, round {search.round_number}, "
        f"within {search.radius_sky_arcsec:.0f} arcsec of its last place"
    )


def alarming_interlocks(loop: LoopState) -> list[TrippedInterlock]:
    """Tripped interlocks, without warnings that the star's light is missing while it is searched for again."""
    if loop.search_again is None:
        return loop.interlocks
    of_star = {row.name for row in loop.watched if row.quantity == "star_flux_fraction"}
    return [row for row in loop.interlocks if row.action != "warn" or row.name not in of_star]


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
