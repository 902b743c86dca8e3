"""What a frame shows in a batched run: only the pixels that the star sensor looks at are rendered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, WINDOW_PX
from fitctl.controllers.attribution import FOLLOWED_PX, MOST_STRANGERS, PROVEN_PX, is_within
from fitctl.controllers.centroid import (
    EDGE_PX,
    LARGEST_PEAK,
    MAX_CANDIDATES,
    MOST_HOT,
    REACH_DIAMETERS,
    window_centre,
)
from fitctl.controllers.spot_fit import NODES, STEPS_PER_PX, node
from fitctl.model.compiled import compilable
from fitctl.model.image.light import REACH_SIGMAS, light_fractions
from fitctl.model.image.scene import render
from fitctl.simulation.batch.laws import ACQUISITION, COARSE, NOT_DUE, VERNIER, has_arrived
from fitctl.simulation.batch.mirror import mirror_px
from fitctl.simulation.batch.siderostat import motor_px

Floats = NDArray[np.float64]
SENSED, WHOLE_FRAME = 1_000_001, 1_000_002  # above the number of any spot


@compilable()
def stages_px(s: Any, r: Any) -> tuple[float, float]:
    """``StarEstimator.stages_px`` at the exposure."""
    az_px, el_px = motor_px(s, r.beam_rad[0], r.beam_rad[1])
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
    window_dn = light_dn[top : top + WINDOW_PX, left : left + WINDOW_PX]
    flux = az_moment = el_moment = peak = 0.0
    for row in range(WINDOW_PX):
        # A sum of its own for each row: one long sum would wait for itself.
        row_dn = row_moment = 0.0
        for column in range(WINDOW_PX):
            dn = window_dn[row, column] - s.bias_dn
            peak = max(peak, dn)
            row_dn += dn
            row_moment += dn * (column - HALF_WINDOW_PX)
        flux += row_dn
        az_moment += row_moment
        el_moment += row_dn * (row - HALF_WINDOW_PX)
    if flux <= 0 or peak > LARGEST_PEAK * flux:
        return math.nan, math.nan, math.nan
    az_px, el_px = az_moment / flux, el_moment / flux
    if s.fits:
        az_px, el_px = fitted(s, window_dn, az_px, el_px)
    return window_az + az_px, window_el + el_px, flux


@compilable(inline=True)
def fitted(s: Any, window_dn: Floats, az_px: float, el_px: float) -> tuple[float, float]:
    """``SpotFit.place`` on pixels that are all good; a batch has no others."""
    for _ in range(2):
        row, column = node(el_px), node(az_px)
        light = az_moment = el_moment = 0.0
        for pixel in range(WINDOW_PX * WINDOW_PX):
            dn = window_dn[pixel // WINDOW_PX, pixel % WINDOW_PX] - s.bias_dn
            light += s.fit_weights[row, column, 0, pixel] * dn
            az_moment += s.fit_weights[row, column, 1, pixel] * dn
            el_moment += s.fit_weights[row, column, 2, pixel] * dn
        if light <= 0:
            return math.nan, math.nan
        az_px = (column - NODES) / STEPS_PER_PX + az_moment / light
        el_px = (row - NODES) / STEPS_PER_PX + el_moment / light
    if max(abs(az_px), abs(el_px)) > HALF_WINDOW_PX:
        return math.nan, math.nan
    return az_px, el_px


@compilable()
def is_followed(r: Any) -> bool:
    """``StellarLoop.spots`` are not empty."""
    return bool(r.mode in (COARSE, VERNIER))


@compilable()
def looks_again(r: Any) -> bool:
    """``StellarLoop.candidate_spots`` are not empty."""
    return bool(r.mode == ACQUISITION and r.has_candidate and not r.waits)


@compilable()
def is_own_star(ss: Any, rr: Any, i: int, az_px: float, el_px: float, flux_dn: float) -> bool:
    """``StarSensor._accepted``."""
    s = ss.stars[i]
    if not s.sensor.flux_low_dn <= flux_dn <= s.sensor.flux_high_dn:
        return False
    for j in range(len(ss.stars)):
        other = rr.stars[j]
        if j != i and is_followed(other):
            away_px = max(abs(az_px - other.star_px[0]), abs(el_px - other.star_px[1]))
            if away_px <= HALF_WINDOW_PX:
                return False
    return True


@compilable()
def subtract_others(ss: Any, rr: Any, w: Any, i: int, window_az: int, window_el: int) -> None:
    """Take the light of other loops' spots from the window, as ``StarSensor._centroid`` does."""
    first_row, first_column = window_el - HALF_WINDOW_PX, window_az - HALF_WINDOW_PX
    for j in range(len(ss.stars)):
        s, r = ss.stars[j], rr.stars[j]
        if j == i or not (is_followed(r) or looks_again(r)):
            continue
        star_az_px, star_el_px = r.star_px[0], r.star_px[1]
        if looks_again(r):
            stages_az_px, stages_el_px = stages_px(s, r)
            star_az_px += stages_az_px - r.seen_stages_px[0]
            star_el_px += stages_el_px - r.seen_stages_px[1]
        for spot in range(s.followed_spots):
            az_px = star_az_px + s.followed_offset_px[spot, 0]
            el_px = star_el_px + s.followed_offset_px[spot, 1]
            away_px = max(abs(az_px - window_az), abs(el_px - window_el))
            if away_px >= WINDOW_PX / 2 + REACH_DIAMETERS * 4 * s.followed_sigma_px:
                continue
            left, right = light_fractions(
                first_column, az_px, s.followed_sigma_px, s.light, w.across
            )
            top, bottom = light_fractions(first_row, el_px, s.followed_sigma_px, s.light, w.down)
            flux_dn = s.followed_part[spot] * r.flux_dn * r.last_visible
            for row in range(top, bottom):
                for column in range(left, right):
                    w.window_dn[row, column] -= flux_dn * w.down[row] * w.across[column]


@compilable()
def accept(r: Any, az_px: float, el_px: float, flux_dn: float) -> None:
    """The star is on the frame."""
    r.star_visible = r.last_visible = 1
    r.star_px[0], r.star_px[1] = az_px, el_px
    r.flux_dn = flux_dn


@compilable()
def measure(ss: Any, rr: Any, ww: Any, i: int, window_az: int, window_el: int) -> bool:
    """``StarSensor.in_window``; False where the whole frame must decide."""
    s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
    first_row, first_column = window_el - HALF_WINDOW_PX, window_az - HALF_WINDOW_PX
    render(
        w.window_dn, first_row, first_column, s.width_px, w.spots_px, ss.flux_dn, ss.sigma_px,
        ss.instants * ss.spots, s.bias_dn, r.noise_dn, s.photon_dn, s.full_dn, r.pixel_key, r.frames,
        s.quantiles, s.light, w.down, w.across,
    )  # fmt: skip
    subtract_others(ss, rr, w, i, window_az, window_el)
    az_px, el_px, flux = centroid(s, w.window_dn, first_row, first_column, window_az, window_el)
    if not is_own_star(ss, rr, i, az_px, el_px, flux):
        return False
    if not (abs(az_px - window_az) <= EDGE_PX and abs(el_px - window_el) <= EDGE_PX):
        return False
    accept(r, az_px, el_px, flux)
    return True


@compilable()
def centroid_on(
    ss: Any, rr: Any, ww: Any, i: int, frame_dn: Floats, window_az: int, window_el: int
) -> Any:
    """:func:`centroid` about a window of a whole frame, without other loops' light."""
    w = ww.stars[i]
    first_row, first_column = window_el - HALF_WINDOW_PX, window_az - HALF_WINDOW_PX
    for row in range(WINDOW_PX):
        for column in range(WINDOW_PX):
            w.window_dn[row, column] = frame_dn[first_row + row, first_column + column]
    subtract_others(ss, rr, w, i, window_az, window_el)
    return centroid(ss.stars[i], w.window_dn, first_row, first_column, window_az, window_el)


@compilable()
def may_be_own(
    s: Any, r: Any, az_px: float, el_px: float, near_az_px: float, near_el_px: float
) -> bool:
    """What ``StarFinder._find_own`` and ``Attribution.choose`` do not leave out."""
    if r.mode != ACQUISITION:
        return is_within(az_px, el_px, near_az_px, near_el_px, FOLLOWED_PX)
    if not s.shared:
        return True
    if r.has_candidate:
        return is_within(az_px, el_px, near_az_px, near_el_px, PROVEN_PX)
    for stranger in range(min(r.strangers, MOST_STRANGERS)):
        place_px = r.strangers_px[stranger]
        if is_within(az_px, el_px, place_px[0], place_px[1], HALF_WINDOW_PX):
            return False
    return True


@compilable()
def find(ss: Any, rr: Any, ww: Any, i: int, frame_dn: Floats, search_dn: Floats) -> None:
    """``StarFinder._find_own``: the nearest, or in the first search of a loop alone the brightest."""
    s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
    stages_az_px, stages_el_px = stages_px(s, r)
    near_az_px, near_el_px = r.star_origin_px[0] + stages_az_px, r.star_origin_px[1] + stages_el_px
    nearest_px = math.inf
    render(
        frame_dn, 0, 0, s.width_px, w.spots_px, ss.flux_dn, ss.sigma_px, ss.instants * ss.spots,
        s.bias_dn, r.noise_dn, s.photon_dn, s.full_dn, r.pixel_key, r.frames, s.quantiles, s.light,
        search_dn[:, 0], search_dn[0],
    )  # fmt: skip
    search_dn[:] = frame_dn
    spots = 0
    for _ in range(MAX_CANDIDATES + MOST_HOT):
        el, az = divmod(np.argmax(search_dn), s.width_px)
        if search_dn[el, az] - s.bias_dn < s.sensor.threshold_dn or spots == MAX_CANDIDATES:
            return
        window_az, window_el = (
            window_centre(az, s.sensor.largest_az_px),
            window_centre(el, s.sensor.largest_el_px),
        )
        az_px, el_px, flux = centroid_on(ss, rr, ww, i, frame_dn, window_az, window_el)
        if not math.isnan(az_px):
            spots += 1
            window_az = window_centre(az_px, s.sensor.largest_az_px)
            window_el = window_centre(el_px, s.sensor.largest_el_px)
            az_px, el_px, flux = centroid_on(ss, rr, ww, i, frame_dn, window_az, window_el)
        centred = abs(az_px - window_az) <= 1.0 and abs(el_px - window_el) <= 1.0
        if centred and is_own_star(ss, rr, i, az_px, el_px, flux):
            if r.mode == ACQUISITION and not s.shared and not r.again:
                accept(r, az_px, el_px, flux)
                return
            away_px = math.hypot(az_px - near_az_px, el_px - near_el_px)
            if away_px < nearest_px and may_be_own(s, r, az_px, el_px, near_az_px, near_el_px):
                accept(r, az_px, el_px, flux)
                nearest_px = away_px
        top, left = max(0, el - HALF_WINDOW_PX), max(0, az - HALF_WINDOW_PX)
        search_dn[top : el + HALF_WINDOW_PX + 1, left : az + HALF_WINDOW_PX + 1] = 0.0


@compilable()
def spots_over(
    ss: Any, rr: Any, ww: Any, spots_px: Floats, left: int, top: int, width: int, height: int
) -> int:
    """Spots of an exposure with light on some pixels: how many; NaN for the others. Of all loops.

    A spot is there once for each instant of the exposure. Where a further spot, whose own air has not been
    drawn so far, might matter: minus its number.
    """
    lit = 0
    for i in range(len(ss.stars)):
        s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
        for seen in range(ss.instants * s.spots):
            instant, spot = divmod(seen, s.spots)
            number, row = s.first_spot + spot, r.exposed_step[instant] - 1
            entry = instant * ss.spots + number
            az_px = r.exposed_px[instant, 0] + s.spot_offset_px[spot, 0]
            el_px = r.exposed_px[instant, 1] + s.spot_offset_px[spot, 1]
            reach_px = (
                REACH_SIGMAS * ss.sigma_px[number] + 1.0 + (s.own_reach_px if spot > 0 else 0.0)
            )
            if not (
                left - reach_px < az_px < left + width - 1 + reach_px
                and top - reach_px < el_px < top + height - 1 + reach_px
            ):
                spots_px[entry, 0] = spots_px[entry, 1] = math.nan
                continue
            if spot > 0:
                if r.own_blocks[spot] <= row // s.block_steps:
                    return -number
                az_px += w.own_px[spot, row % s.ring_steps, 0] * s.air_relative
                el_px += w.own_px[spot, row % s.ring_steps, 1] * s.air_relative
            spots_px[entry, 0], spots_px[entry, 1] = az_px, el_px
            lit += 1
    return lit


@compilable()
def follows(r: Any) -> bool:
    """The star is expected where it was."""
    return bool(r.mode != ACQUISITION and r.lost == 0)


@compilable()
def sense(ss: Any, rr: Any, ww: Any, i: int) -> int:
    """``StellarLoop._find`` as far as a window shows: SENSED, or WHOLE_FRAME if :func:`find` must look.

    Negative: the number of a spot that might matter, and needs more air first.
    """
    s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
    r.star_visible = 0
    if r.mode == ACQUISITION and (r.search_due != NOT_DUE or r.waits or not has_arrived(s, r)):
        return SENSED
    r.last_visible = 0
    if follows(r):
        az_px, el_px = stages_px(s, r)
        az = window_centre(r.star_origin_px[0] + az_px, s.sensor.largest_az_px)
        el = window_centre(r.star_origin_px[1] + el_px, s.sensor.largest_el_px)
        left, top = az - HALF_WINDOW_PX, el - HALF_WINDOW_PX
        lit = spots_over(ss, rr, ww, w.spots_px, left, top, WINDOW_PX, WINDOW_PX)
        if lit < 0:
            return lit
        if measure(ss, rr, ww, i, az, el):
            return SENSED
    lit = spots_over(ss, rr, ww, w.spots_px, 0, 0, s.width_px, s.height_px)
    if lit > 0 or (lit == 0 and not s.noise_is_dark):
        return WHOLE_FRAME
    # Nothing but noise is there, and that alone finds no star.
    return lit
