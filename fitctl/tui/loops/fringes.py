"""The fringes of two stars: visibility, what pointing lets expect, and the tilt between the wavefronts."""

from __future__ import annotations

import math

import numpy as np

from fitctl.messages.telemetry import FringeOptics
from fitctl.tui.inks import DIM, GREEN, INK, WHITE
from fitctl.tui.look import Line, bar, faded, number, text, width
from fitctl.tui.loops.band import age, present_rms
from fitctl.tui.state import ConsoleState, Rms

LIVE_S = 1.0
BAR_COLUMNS = 10
RAD_PER_ARCSEC = math.pi / (180.0 * 3600.0)


def has_fringes(state: ConsoleState) -> bool:
    """Whether the rig has two stars that interfere."""
    newest = state.newest
    return newest is not None and (newest.fringes is not None or state.overlap is not None)


def expected_visibility(
    optics: FringeOptics, one: Rms, other: Rms, sky_arcsec_per_px: float
) -> float:
    """Mean visibility that two pointing errors about their targets leave; not-a-number without both.

    The errors are independent and Gaussian, and ``2 J1(x)/x`` is taken as ``exp(-x**2/8)``, which is within
    0.01 of it for a visibility above 0.8. Less visibility than this comes from a standing tilt.
    """
    wave_per_arcsec = math.pi * optics.aperture_m / optics.wavelength_m * RAD_PER_ARCSEC
    to_x = wave_per_arcsec * sky_arcsec_per_px
    variance_az = to_x**2 * (one.az_px**2 + other.az_px**2)
    variance_el = to_x**2 * (one.el_px**2 + other.el_px**2)
    return 1.0 / math.sqrt((1.0 + variance_az / 4.0) * (1.0 + variance_el / 4.0))


def _expected(state: ConsoleState) -> float:
    optics = state.newest.fringes if state.newest else None
    loops = [state.loops[name] for name in (optics.loops if optics else ()) if name in state.loops]
    if optics is None or len(loops) != 2:
        return math.nan
    one, other = (present_rms(state, loop) for loop in loops)
    return expected_visibility(optics, one, other, loops[0].state.sky_arcsec_per_px)


def fringe_line(state: ConsoleState, columns: int) -> Line:
    """Visibility over the last second, beside what the RMS of both loops lets expect, and the tilt now."""
    ago = f", {age(state.silent_s)} ago" if state.stale else ""
    label: Line = [text(f" fringes{ago}  ", DIM)]
    recent = state.fringes.since(
        state.fringes.newest_s - LIVE_S, "visibility", "tilt_az_arcsec", "tilt_el_arcsec"
    )
    is_old = state.newest is None or state.newest.time_s - state.fringes.newest_s > LIVE_S
    held = recent[np.isfinite(recent).all(axis=1)]
    if is_old or not len(held):
        return [*label, text("no visibility: both loops must hold a star", DIM)]
    visibility, az_arcsec, el_arcsec = held.mean(axis=0)
    tilt = f"{number(az_arcsec, '+.2f')}″ {number(el_arcsec, '+.2f')}″"
    parts: list[Line] = [
        [text("V ", DIM), text(number(visibility, ".2f"), WHITE, bold=True)],
        [text("  expected ", DIM), text(number(_expected(state), ".2f"), INK)],
        [text("  tilt az el ", DIM), text(tilt, INK)],
        [text("  "), *bar(visibility, BAR_COLUMNS, GREEN)],
    ]
    line = label
    for part in parts:
        if width(line) + width(part) <= columns:
            line += part
    return faded(line) if state.stale else line
