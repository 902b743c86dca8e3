"""The camera: what its pixels can count, what its link can carry, and what a star looks like on it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.devices import FULL_SCALE_DN, HALF_WINDOW_PX
from fitctl.config.loops import Loop
from fitctl.config.rig import Rig

_BYTES_PX = {"Mono8": 1, "Mono12": 2, "Mono16": 2}  # Mono12 unpacked
_PACKET_HEADERS_BYTES = 36  # IP, UDP and GVSP
_FASTEST_LINK_BYTES_S = 1.25e9  # 10 Gbit/s, the fastest that GigE Vision cameras have


def camera_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Between the camera's own keys, and between them and each star."""
    yield from _delay(rig)
    yield from _link(rig)
    yield from _bias(rig)
    for name, loop in rig.stellar_loops.items():
        yield from _target(rig, name, loop)
        yield from _star(rig, name, loop)


def _delay(rig: Rig) -> Iterator[Conflict]:
    camera = rig.camera
    if camera.frame_delay_s < camera.exposure_s / 2:
        yield Conflict(
            "the delay counts from mid-exposure, and no frame is read before its exposure ends",
            (
                at_least("camera.frame_delay_s", camera.frame_delay_s, camera.exposure_s / 2),
                at_most("camera.exposure_s", camera.exposure_s, 2 * camera.frame_delay_s),
            ),
        )


def _link(rig: Rig) -> Iterator[Conflict]:
    camera, device = rig.camera, rig.camera.device
    frame_bytes = camera.width_px * camera.height_px * _BYTES_PX[device.pixel_format]
    rate_hz = camera.frame_rate_hz
    fits = _FASTEST_LINK_BYTES_S / (frame_bytes * rate_hz)
    if fits < 1:
        yield Conflict(
            f"frames of {frame_bytes} bytes do not pass a link of 10 Gbit/s at that rate",
            (
                at_most("camera.frame_rate_hz", rate_hz, rate_hz * fits),
                at_most("camera.width_px", camera.width_px, math.floor(camera.width_px * fits)),
                at_most("camera.height_px", camera.height_px, math.floor(camera.height_px * fits)),
            ),
        )
    packets = 2 + math.ceil(frame_bytes / (device.packet_size_bytes - _PACKET_HEADERS_BYTES))
    pauses_s = packets * device.packet_delay_s
    if pauses_s > camera.period_s:
        yield Conflict(
            f"the pauses between the {packets} packets of a frame take {pauses_s:g} s",
            (
                at_most(
                    "camera.device.packet_delay_s", device.packet_delay_s, camera.period_s / packets
                ),
                at_most("camera.frame_rate_hz", rate_hz, 1 / pauses_s),
            ),
        )


def _bias(rig: Rig) -> Iterator[Conflict]:
    pixel_format, bias_dn = rig.camera.device.pixel_format, rig.camera.bias_dn
    full_dn = rig.camera.full_scale_dn
    if bias_dn >= full_dn:
        yield Conflict(
            f"a pixel of {pixel_format} counts to {full_dn}",
            (
                Part("camera.bias_dn", bias_dn, f"below {full_dn}"),
                _larger_format(pixel_format, bias_dn),
            ),
        )


def _target(rig: Rig, name: str, loop: Loop) -> Iterator[Conflict]:
    for axis, size in (("az", "width_px"), ("el", "height_px")):
        place, size_px = getattr(loop.target_px, axis), getattr(rig.camera, size)
        last = size_px - 1 - HALF_WINDOW_PX
        if HALF_WINDOW_PX <= place <= last:
            continue
        demand = f"from {HALF_WINDOW_PX} to {last}"
        parts = [Part(f"loops.{name}.target_px.{axis}", place, demand)]
        if place > last:
            least = math.ceil(place) + 1 + HALF_WINDOW_PX
            parts.append(at_least(f"camera.{size}", size_px, least))
        yield Conflict("the 7x7 window about the target must fit on the frame", tuple(parts))


def _star(rig: Rig, name: str, loop: Loop) -> Iterator[Conflict]:
    """A star on its target must be detected, not saturate a pixel, and be alone in its window."""
    camera = rig.camera
    key = f"loops.{name}"
    pixel_format = camera.device.pixel_format
    full_dn = camera.full_scale_dn
    part = loop.brightest_part
    brightest_dn = part * loop.star_flux_dn
    if camera.bias_dn < full_dn < camera.bias_dn + brightest_dn:
        yield Conflict(
            f"the star's brightest pixel would reach {camera.bias_dn + brightest_dn:.0f} DN, and a pixel of "
            f"{pixel_format} counts to {full_dn}",
            (
                at_most(
                    f"{key}.star_flux_dn", loop.star_flux_dn, (full_dn - camera.bias_dn) / part
                ),
                _larger_format(pixel_format, camera.bias_dn + brightest_dn),
                at_most("camera.bias_dn", camera.bias_dn, full_dn - brightest_dn),
            ),
        )
    sigma, noise_dn = loop.acquisition.detection_sigma, camera.pixel_noise_dn
    if brightest_dn < sigma * noise_dn:
        yield Conflict(
            f"the star's brightest pixel has {brightest_dn:.4g} DN and would never be detected",
            (
                at_least(f"{key}.star_flux_dn", loop.star_flux_dn, sigma * noise_dn / part),
                at_most("camera.pixel_noise_dn", noise_dn, brightest_dn / sigma),
                at_most(f"{key}.acquisition.detection_sigma", sigma, brightest_dn / noise_dn),
            ),
        )
    for spot in loop.other_spots:
        apart_px = max(abs(spot.offset_px.az), abs(spot.offset_px.el))
        if apart_px <= HALF_WINDOW_PX:
            demand = f"more than {HALF_WINDOW_PX} px away from the star on one axis"
            yield Conflict(
                f"spot {spot.name} would lie in the star's own window and pull its centroid",
                (Part(f"{key}.other_spots", apart_px, demand),),
            )


def _larger_format(pixel_format: str, needed_dn: float) -> Part:
    larger = [one for one, full_dn in FULL_SCALE_DN.items() if full_dn > needed_dn]
    return Part("camera.device.pixel_format", pixel_format, " or ".join(larger))
