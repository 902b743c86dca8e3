"""The search on the sky: the spiral, the way so far, the field of view where it is now."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from fitctl.messages.telemetry import LoopLimits
from fitctl.tui.draw import braille
from fitctl.tui.inks import DIM, FAINT, GREEN, INK, SKY, YELLOW
from fitctl.tui.look import Line, in_columns, number, text
from fitctl.tui.state import LoopView

NOTES_COLUMNS = 24
_ANGLES = np.linspace(0, 2 * math.pi, 400)


def search_lines(loop: LoopView, field_px: int, columns: int, rows: int) -> list[Line]:
    """A map with the search's numbers beside it; `field_px` is the camera's width."""
    state, tick = loop.state, loop.beam or loop.tick
    if tick is None or state.limits is None or state.search_centre_sky_arcsec is None:
        return [[text("searching", YELLOW)]]
    centre = np.array(state.search_centre_sky_arcsec)
    here = np.array([tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec])
    field_arcsec = 0.0 if loop.beam else field_px * state.sky_arcsec_per_px
    limits = state.limits
    if state.search_again is not None:
        radius = state.search_again.radius_sky_arcsec
        limits = msgspec.structs.replace(limits, search_radius_sky_arcsec=radius)
    notes = _notes(loop, limits, here, field_arcsec)
    map_columns = max(6, min(columns - NOTES_COLUMNS, 2 * rows + 4))
    drawn = _map(loop, limits, centre, here, field_arcsec, map_columns, rows)
    return in_columns(drawn, map_columns + 1, notes)


def _map(
    loop: LoopView,
    limits: LoopLimits,
    centre: np.ndarray,
    here: np.ndarray,
    field_arcsec: float,
    columns: int,
    rows: int,
) -> list[Line]:
    """Dots are as high as wide: four a row, two a column."""
    reach_arcsec = limits.search_radius_sky_arcsec + field_arcsec / 2
    high, wide = 4 * rows, 2 * columns
    least = min(high, wide)
    half = np.array([wide / least, high / least]) * reach_arcsec

    def placed(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part = (at - centre) / (2 * half) + 0.5
        return part[:, 0], part[:, 1]

    circle = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    edge, ahead, way, field = (braille.empty(rows, columns) for _ in range(4))
    braille.scatter(edge, *placed(centre + limits.search_radius_sky_arcsec * circle))
    angles = np.linspace(
        0,
        2 * math.pi * limits.search_radius_sky_arcsec / limits.spiral_pitch_sky_arcsec,
        1200,
    )
    radius = limits.spiral_pitch_sky_arcsec * angles / (2 * math.pi)
    spiral = centre + radius[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    braille.scatter(ahead, *placed(spiral[::3]))
    if loop.search_trail_sky_arcsec:
        braille.polyline(way, *placed(np.array([*loop.search_trail_sky_arcsec, here])))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * field_arcsec / 2
    braille.polyline(field, *placed(here + corners))
    return braille.layered([(edge, DIM), (ahead, FAINT), (way, YELLOW), (field, GREEN)])


def _notes(loop: LoopView, limits: LoopLimits, here: np.ndarray, field_arcsec: float) -> list[Line]:
    tick, beam = loop.tick, loop.beam
    searching = beam or tick
    progress = searching.search_progress if searching else math.nan
    found = tick is not None and tick.star_visible
    if beam is not None:
        found = math.isfinite(beam.beam_az_arcsec)
    what = "star" if beam is None else "beam"
    field = [[text("▯ ", GREEN), text(f"field, {field_arcsec:.0f}″", DIM)]] if field_arcsec else []
    return [
        [text("searched ", DIM), text(f"{number(100 * progress, '.0f')} %", INK, bold=True)],
        [text("at ", DIM), text(f"{number(here[0], '+.0f')}″ {number(here[1], '+.0f')}″", INK)],
        [
            text(
                f"● a {what} is seen" if found else f"○ no {what} yet",
                GREEN if found else YELLOW,
            )
        ],
        [],
        [text("─ ", YELLOW), text("way so far", DIM)],
        *field,
        [text("· ", SKY), text(f"radius {limits.search_radius_sky_arcsec:g}″", DIM)],
    ]
