"""What a frame shows in a batched run: only the pixels that the star sensor looks at are rendered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX
from fitctl.controllers.centroid import EDGE_PX, LARGEST_PEAK, MAX_CANDIDATES, window_centre
from fitctl.model.compiled import compilable
from fitctl.model.light import REACH_SIGMAS
from fitctl.model.scene import render
from fitctl.simulation.batch.laws import ACQUISITION, has_arrived
from fitctl.simulation.batch.mirror import mirror_px
from fitctl.simulation.batch.records import SIDE_PX
from fitctl.simulation.batch.siderostat import motor_px

Floats = NDArray[np.float64]
SENSED, WHOLE_FRAME = 1_000_001, 1_000_002  # above the number of any spot


@compilable()
def stages_px(s: Any, r: Any) -> tuple[float, float]:
    """``StarEstimator.stages_px`` at the exposure."""
    az_px, el_px = motor_px(s, r.motor_rad[0], r.motor_rad[1])
    mirror_az_px, mirror_el_px = mirror_px(s, r.exposed_mirror_rad[0], r.exposed_mirror_rad[1])
    return az_px + mirror_az_px, el_px + mirror_el_px


@compilable(inline=True)
def centroid(
    s: Any, light_dn: Floats, first_row: int, first_column: int, window_az: int, window_el: int
) -> Any:
    """``StarSensor._centroid`` about a window on a part of the frame: azimuth, elevation, flux.

    All nan where there is no light, or one pixel has most of it.
    """
    top, left = window_el - HALF_WINDOW_PX - first_row, window_az - HALF_WINDOW_PX - first_column
    window_dn = light_dn[top : top + SIDE_PX, left : left + SIDE_PX]
    flux = az_moment = el_moment = peak = 0.0
    for row in range(SIDE_PX):
        # A sum of its own for each row: one long sum would wait for itself.
        row_dn = row_moment = 0.0
        for column in range(SIDE_PX):
            dn = window_dn[row, column] - s.bias_dn
            peak = max(peak, dn)
            row_dn += dn
            row_moment += dn * (column - HALF_WINDOW_PX)
        flux += row_dn
        az_moment += row_moment
        el_moment += row_dn * (row - HALF_WINDOW_PX)
    if flux <= 0 or peak > LARGEST_PEAK * flux:
        return math.nan, math.nan, math.nan
    return window_az + az_moment / flux, window_el + el_moment / flux, flux


@compilable()
def in_flux_range(s: Any, flux_dn: float) -> bool:
    """``StarSensor._accepted``."""
    return s.sensor.flux_low_dn <= flux_dn <= s.sensor.flux_high_dn


@compilable()
def accept(r: Any, az_px: float, el_px: float) -> None:
    """The star is on the frame."""
    r.star_visible = 1
    r.star_px[0], r.star_px[1] = az_px, el_px


@compilable()
def measure(s: Any, r: Any, w: Any, window_az: int, window_el: int) -> bool:
    """``StarSensor.measure``; False where the whole frame must decide (``StarSensor.follow``)."""
    first_row, first_column = window_el - HALF_WINDOW_PX, window_az - HALF_WINDOW_PX
    render(
        w.window_dn, first_row, first_column, s.width_px, w.spots_px, s.flux_dn, s.sigma_px, s.spots,
        s.bias_dn, s.noise_dn, s.full_dn, r.pixel_key, r.frames, s.quantiles, s.light,
        w.down, w.across,
    )  # fmt: skip
    az_px, el_px, flux = centroid(s, w.window_dn, first_row, first_column, window_az, window_el)
    if not in_flux_range(s, flux):
        return False
    if abs(az_px - window_az) > EDGE_PX or abs(el_px - window_el) > EDGE_PX:
        return False
    accept(r, az_px, el_px)
    return True


@compilable()
def find(s: Any, r: Any, w: Any, frame_dn: Floats, search_dn: Floats) -> None:
    """``StarSensor.find`` over a whole frame."""
    render(
        frame_dn, 0, 0, s.width_px, w.spots_px, s.flux_dn, s.sigma_px, s.spots,
        s.bias_dn, s.noise_dn, s.full_dn, r.pixel_key, r.frames, s.quantiles, s.light,
        search_dn[:, 0], search_dn[0],
    )  # fmt: skip
    search_dn[:] = frame_dn
    for _ in range(MAX_CANDIDATES):
        el, az = divmod(np.argmax(search_dn), s.width_px)
        if search_dn[el, az] - s.bias_dn < s.sensor.threshold_dn:
            return
        window_az, window_el = (
            window_centre(az, s.sensor.largest_az_px),
            window_centre(el, s.sensor.largest_el_px),
        )
        az_px, el_px, flux = centroid(s, frame_dn, 0, 0, window_az, window_el)
        if flux > 0:
            window_az = window_centre(az_px, s.sensor.largest_az_px)
            window_el = window_centre(el_px, s.sensor.largest_el_px)
            az_px, el_px, flux = centroid(s, frame_dn, 0, 0, window_az, window_el)
        centred = abs(az_px - window_az) <= 1.0 and abs(el_px - window_el) <= 1.0
        if in_flux_range(s, flux) and centred:
            accept(r, az_px, el_px)
            return
        top, left = max(0, el - HALF_WINDOW_PX), max(0, az - HALF_WINDOW_PX)
        search_dn[top : el + HALF_WINDOW_PX + 1, left : az + HALF_WINDOW_PX + 1] = 0.0


@compilable()
def spots_over(s: Any, r: Any, w: Any, left: int, top: int, width: int, height: int) -> int:
    """Spots of an exposure with light on some pixels: how many; NaN for the others.

    Where a further spot, whose own air has not been drawn so far, might matter: minus its number.
    """
    lit, block = 0, s.block_steps
    row = r.exposed_step - 1
    for spot in range(s.spots):
        az_px = r.exposed_px[0] + s.spot_offset_px[spot, 0]
        el_px = r.exposed_px[1] + s.spot_offset_px[spot, 1]
        reach_px = REACH_SIGMAS * s.sigma_px[spot] + 1.0 + (s.own_reach_px if spot > 0 else 0.0)
        if not (
            left - reach_px < az_px < left + width - 1 + reach_px
            and top - reach_px < el_px < top + height - 1 + reach_px
        ):
            w.spots_px[spot, 0] = w.spots_px[spot, 1] = math.nan
            continue
        if spot > 0:
            if r.own_blocks[spot] <= row // block:
                return -spot
            az_px += w.own_px[spot, row % block, 0] * s.air_relative
            el_px += w.own_px[spot, row % block, 1] * s.air_relative
        w.spots_px[spot, 0], w.spots_px[spot, 1] = az_px, el_px
        lit += 1
    return lit


@compilable()
def sense(s: Any, r: Any, w: Any) -> int:
    """``StellarLoop._find`` as far as a window shows: SENSED, or WHOLE_FRAME if :func:`find` must look.

    Negative: the number of a spot that might matter, and needs more air first.
    """
    r.star_visible = 0
    if r.mode == ACQUISITION and not has_arrived(s, r):
        return SENSED
    if r.mode != ACQUISITION and r.lost == 0:
        az_px, el_px = stages_px(s, r)
        az = window_centre(r.star_origin_px[0] + az_px, s.sensor.largest_az_px)
        el = window_centre(r.star_origin_px[1] + el_px, s.sensor.largest_el_px)
        left, top = az - HALF_WINDOW_PX, el - HALF_WINDOW_PX
        lit = spots_over(s, r, w, left, top, SIDE_PX, SIDE_PX)
        if lit < 0:
            return lit
        if measure(s, r, w, az, el):
            return SENSED
    lit = spots_over(s, r, w, 0, 0, s.width_px, s.height_px)
    if lit > 0 or (lit == 0 and not s.noise_is_dark):
        return WHOLE_FRAME
    # Nothing but noise is there, and that alone finds no star.
    return lit
