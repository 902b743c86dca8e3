"""Several loops on one camera: their windows stay apart, and no sum of their spots looks like a star."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

from fitctl.config.conflict import Conflict, Part, above, at_least, at_most
from fitctl.config.devices import HALF_WINDOW_PX, WINDOW_PX
from fitctl.config.loops import Loop
from fitctl.config.rig import Rig

_Star = tuple[str, Loop]


def focal_plane_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of each pair of stars."""
    for one, other in itertools.combinations(rig.stellar_loops.items(), 2):
        yield from _windows(rig, one, other)
    yield from _overlapping_spots(rig)


def _windows(rig: Rig, one: _Star, other: _Star) -> Iterator[Conflict]:
    """A window and the reach of a mirror between them, or one loop's star could enter the other's window."""
    places = [(loop.target_px.az, loop.target_px.el) for _, loop in (one, other)]
    apart_px = max(abs(a - b) for a, b in zip(*places, strict=True))
    far, loop = max((one, other), key=lambda star: _reach_px(rig, star[1]))
    reach_px = _reach_px(rig, loop)
    if apart_px >= WINDOW_PX + reach_px:
        return
    first, second = (f"loops.{name}.target_px" for name, _ in (one, other))
    demand = f"at least {WINDOW_PX + reach_px:.2f} px from {{}}"
    fits = max(apart_px - WINDOW_PX, 0) / reach_px
    yield Conflict(
        f"the targets are {apart_px:g} px apart, and a window and the reach of a mirror must fit between them",
        (
            Part(second, list(places[1]), demand.format(first)),
            Part(first, list(places[0]), demand.format(second)),
            at_most(f"loops.{far}.fsm.range_rad", loop.fsm.range_rad, loop.fsm.range_rad * fits),
            at_most(
                f"loops.{far}.fsm.beam_per_mirror",
                loop.fsm.beam_per_mirror,
                loop.fsm.beam_per_mirror * fits,
            ),
            *_scale(rig, fits),
        ),
    )


def _scale(rig: Rig, fits: float) -> tuple[Part, ...]:
    if fits == 0:
        return ()
    pixel_m, focal_m = rig.camera.pixel_size_m, rig.optics.focal_length_m
    return (
        at_least("camera.pixel_size_m", pixel_m, pixel_m / fits),
        at_most("optics.focal_length_m", focal_m, focal_m * fits),
    )


def _reach_px(rig: Rig, loop: Loop) -> float:
    fsm = loop.fsm
    return fsm.range_rad * fsm.beam_per_mirror * rig.optics.focal_length_m / rig.camera.pixel_size_m


def _overlapping_spots(rig: Rig) -> Iterator[Conflict]:
    """Other spots of two loops that lie on each other interfere: amplitudes add, not light."""
    spots = [
        (name, spot, loop.target_px.az + spot.offset_px.az, loop.target_px.el + spot.offset_px.el)
        for name, loop in rig.stellar_loops.items()
        for spot in loop.other_spots
    ]
    full_dn = rig.camera.full_scale_dn - rig.camera.bias_dn
    for (one, first, az, el), (other, second, az2, el2) in itertools.combinations(spots, 2):
        if one == other or max(abs(az - az2), abs(el - el2)) > HALF_WINDOW_PX:
            continue
        together_dn = (math.sqrt(first.flux_dn) + math.sqrt(second.flux_dn)) ** 2
        here = (
            f"{second.name} lies on {first.name} of loop {one}, and both reach {together_dn:g} DN"
        )
        fluxes = tuple(
            Part(f"loops.{name}.other_spots", spot.flux_dn, "dimmer, by flux_dn, or elsewhere")
            for name, spot in ((other, second), (one, first))
        )
        if together_dn > full_dn:
            yield Conflict(f"{here}, beyond the camera's {full_dn:g}", fluxes)
        for name, loop in rig.stellar_loops.items():
            low_dn, high_dn = loop.flux_range_dn
            if low_dn <= together_dn <= high_dn:
                low = loop.flux_range.low
                narrow = above(f"loops.{name}.flux_range.low", low, together_dn / loop.star_flux_dn)
                yield Conflict(
                    f"{here}: loop {name} could accept it as its star, which may have {low_dn:g} to "
                    f"{high_dn:g}",
                    (*fluxes, narrow),
                )
