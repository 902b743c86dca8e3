"""The loop of a link: a supervisor of its own holds the beam on the photodiodes."""

from __future__ import annotations

import math
import time

import numpy as np

from fitctl.commissioning.closed import ACQUIRE_S, HELD_S, SETTLED_S, Loop, supervised
from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Mode


def moves(site: Site) -> str:
    """What the step moves."""
    radius_arcsec = site.rig.loops[site.name].acquisition.search_radius_sky_arcsec
    return (
        f"the siderostat of {site.name}, to its beam and up to {radius_arcsec:g} arcsec on the sky in search "
        f"of it; then as in operation, for {HELD_S:g} s"
    )


def check_link(site: Site) -> Outcome:
    """Close the loop of the link, and hold its beam on the photodiodes.

    Raises
    ------
    StepError
        If the beam is not found, is lost, or is not held to the requirement.
    """
    wanted_arcsec = site.rig.metrology_loops[site.name].requirement_arcsec
    with supervised(site) as loop:
        began_s = time.monotonic()
        loop.command(Acquire())
        if math.isnan(loop.wait_for(Mode.LOCKED, ACQUIRE_S)):
            mode = loop.mode_of(site.name)
            msg = f"the beam is not held after {ACQUIRE_S:g} s, the loop is in {mode}: {loop.reason()}"
            raise StepError(msg)
        figures = {"acquired_s": time.monotonic() - began_s}
        time.sleep(SETTLED_S)
        figures |= _beam_held(site, loop)
        figures["stop_s"] = loop.stop()
    rms_arcsec = max(figures["rms_az_arcsec"], figures["rms_el_arcsec"])
    lines = [
        f"held for {HELD_S:g} s: RMS az {figures['rms_az_arcsec']:.3f}, el {figures['rms_el_arcsec']:.3f}, "
        f"worst {figures['worst_arcsec']:.3f} arcsec (requirement {wanted_arcsec:g} arcsec RMS)"
    ]
    if rms_arcsec > wanted_arcsec:
        msg = (
            f"the beam is held to {rms_arcsec:.2f} arcsec RMS; the requirement is {wanted_arcsec:g} arcsec; "
            "check the laser's power, the photodiodes and the gain of the loop"
        )
        raise StepError(msg, figures)
    return Outcome(lines, figures)


def _beam_held(site: Site, loop: Loop) -> dict[str, float]:
    """The RMS of the beam's angle from the centre, and the worst, over some time."""
    since_s = time.monotonic()
    seen: list[tuple[float, float]] = []
    while time.monotonic() < since_s + HELD_S:
        telemetry = loop.client.receive(0.5)
        for tick in () if telemetry is None else telemetry.metrology_ticks:
            if tick.loop != site.name or tick.time_s < since_s:
                continue
            if tick.mode != Mode.LOCKED.name:
                msg = (
                    f"the loop left LOCKED for {tick.mode} while it held the beam: {loop.reason()}"
                )
                raise StepError(msg)
            seen.append((tick.beam_az_arcsec, tick.beam_el_arcsec))
    angles = np.array(seen).reshape(-1, 2)
    angles = angles[np.isfinite(angles).all(axis=1)]
    if not len(angles):
        msg = f"no angle of the beam was measured within {HELD_S:g} s; check the photodiodes"
        raise StepError(msg)
    az, el = np.sqrt(np.mean(angles**2, axis=0))
    return {
        "rms_az_arcsec": float(az),
        "rms_el_arcsec": float(el),
        "worst_arcsec": float(np.max(np.abs(angles))),
    }
