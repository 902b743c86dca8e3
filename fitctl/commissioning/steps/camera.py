"""The camera: what it reads in the dark, how fast and how late its frames are, and what is on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.config import Camera
from fitctl.daemon.devices import CAMERAS
from fitctl.drivers.interface import CameraDriver, DeviceError, Frame

FRAMES = 150
_LEAST_IMAGES, _MOST_IMAGES_BYTES = 10, 128 << 20  # kept of them
_TIMEOUT_S = 1.0
_BIAS_SIGMAS = 0.5  # of one pixel's noise; the median over all pixels is much better known
_NOISE_APART = 0.25
_RATE_APART = 0.005
_DELAY_APART_S = 0.004
_LOST = 0.01
_HOT_SIGMAS = 20.0
_OF_A_SPOT = 0.2  # of a pixel's light: a neighbour of a hot one has less
_COSMIC_RAYS = 2  # that may meet one pixel in so many images


@contextmanager
def streaming(site: Site) -> Iterator[CameraDriver]:
    """The rig's camera with its stream running.

    Raises
    ------
    StepError
        If it fails.
    """
    camera = CAMERAS[site.rig.camera.device.driver](site.rig.camera)
    try:
        camera.open()
        camera.start()
        yield camera
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        camera.close()


def check_camera(site: Site) -> Outcome:
    """Take frames and compare them with the rig file's camera.

    Raises
    ------
    StepError
        If the camera fails or its frames cannot be used.
    """
    settings = site.rig.camera
    with streaming(site) as camera:
        frames = _take(camera, FRAMES, _kept_images(settings))
        counts = camera.counts()
    images = np.array([frame.image for frame in frames if frame.image.size])
    exposed_s = np.array([frame.mid_exposure_s for frame in frames])
    numbers = np.array([frame.number for frame in frames])
    delays_s = np.array([frame.received_s for frame in frames]) - exposed_s
    middle = np.median(images, axis=0)
    hot = _hot_pixels(middle, settings.pixel_noise_dn)
    figures = {
        "bias_dn": float(np.median(middle)),
        "noise_dn": 1.4826 * float(np.median(_deviations(images, middle))),
        "brightest_dn": _brightest(images, hot),
        "hot_pixels": float(len(hot)),
        "frame_rate_hz": float(np.ptp(numbers) / np.ptp(exposed_s)),
        "frame_delay_s": float(np.median(delays_s)),
        "frames_lost": float(counts.lost),
        "packets_lost": float(counts.packets_lost),
    }
    _refuse(settings, figures)
    found: dict[str, Any] = {}
    if abs(figures["bias_dn"] - settings.bias_dn) > _BIAS_SIGMAS * settings.pixel_noise_dn:
        found["bias_dn"] = round(figures["bias_dn"], 1)
    if abs(figures["noise_dn"] / settings.pixel_noise_dn - 1) > _NOISE_APART:
        found["pixel_noise_dn"] = round(figures["noise_dn"], 2)
    if abs(figures["frame_delay_s"] - settings.frame_delay_s) > _DELAY_APART_S:
        found["frame_delay_s"] = round(figures["frame_delay_s"], 3)
    lines = [
        f"dark {figures['bias_dn']:.0f} DN, noise {figures['noise_dn']:.1f} DN, brightest "
        f"{figures['brightest_dn']:.0f} DN",
        f"{figures['frame_rate_hz']:.3f} frames/s, {1e3 * figures['frame_delay_s']:.1f} ms late, "
        f"{counts.lost} lost",
    ]
    if hot:
        places = ", ".join(f"({az}, {el})" for az, el in hot[:12])
        lines.append(f"{len(hot)} hot pixels at (az, el) {places}: run `fitctl sequence run dark`")
    return Outcome(lines, figures, {"camera": found} if found else {})


def _kept_images(camera: Camera) -> int:
    """How many images are evaluated: as many as the memory of a small computer has room for."""
    image_bytes = 2 * camera.width_px * camera.height_px
    return max(_LEAST_IMAGES, min(FRAMES, _MOST_IMAGES_BYTES // image_bytes))


def _deviations(images: NDArray[np.uint16], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median absolute deviation of each pixel; row by row, which needs little memory."""
    rows = zip(images.swapaxes(0, 1), middle, strict=True)
    return np.array([np.median(np.abs(row - row_middle), axis=0) for row, row_middle in rows])


def _brightest(images: NDArray[np.uint16], hot: list[tuple[int, int]]) -> float:
    """The most light that pixels have which are not hot, apart from cosmic rays."""
    often = np.partition(images, -1 - _COSMIC_RAYS, axis=0)[-1 - _COSMIC_RAYS]
    for az, el in hot:
        often[el, az] = 0
    return float(often.max())


def _take(camera: CameraDriver, count: int, images: int) -> list[Frame]:
    """So many frames; the later ones without their image."""
    frames: list[Frame] = []
    missed = 0
    while len(frames) < count:
        frame = camera.next_frame(_TIMEOUT_S)
        if frame is not None:
            image = frame.image if len(frames) < images else frame.image[:0]
            frames.append(frame._replace(image=image.copy()))
            continue
        missed += 1
        if missed > 2:
            msg = (
                f"{len(frames)} of {count} frames came; check the camera's link, packet_size_bytes and the "
                "firewall"
            )
            raise StepError(msg)
    return frames


def _hot_pixels(image: NDArray[np.float64], noise_dn: float) -> list[tuple[int, int]]:
    """Pixels that read more than their neighbours could if it were light: (az, el)."""
    above = image - np.median(image)
    padded = np.pad(above, 1)
    rows, columns = image.shape
    neighbours = np.max(
        [
            padded[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
            for down in (-1, 0, 1)
            for right in (-1, 0, 1)
            if (down, right) != (0, 0)
        ],
        axis=0,
    )
    hot = (above > _HOT_SIGMAS * noise_dn) & (neighbours < _OF_A_SPOT * above)
    return [(int(column), int(row)) for row, column in np.argwhere(hot)]


def _refuse(settings: Any, figures: dict[str, float]) -> None:
    """Raise StepError for what no key of the rig file puts right."""
    if figures["brightest_dn"] >= settings.full_scale_dn:
        msg = (
            f"a pixel reads {figures['brightest_dn']:.0f} DN, all that "
            f"{settings.device.pixel_format} has: the star "
            "saturates; lower camera.exposure_s or camera.device.gain, or put a filter before it"
        )
        raise StepError(msg, figures)
    apart = figures["frame_rate_hz"] / settings.frame_rate_hz - 1
    if abs(apart) > _RATE_APART:
        msg = (
            f"the camera takes {figures['frame_rate_hz']:.2f} frames a second, set to "
            f"{settings.frame_rate_hz:g}; check "
            "its trigger and that exposure_s fits, or set camera.frame_rate_hz to what it does"
        )
        raise StepError(msg, figures)
    if figures["frames_lost"] > _LOST * FRAMES:
        msg = (
            f"{figures['frames_lost']:.0f} of {FRAMES} frames were lost; check the network link and "
            "packet_size_bytes, or raise packet_delay_s"
        )
        raise StepError(msg, figures)
