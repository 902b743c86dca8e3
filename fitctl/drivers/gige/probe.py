"""What `fitctl doctor` asks a camera, without taking control of it and without writing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import NamedTuple

from fitctl.config import Camera
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.features import EXPOSURE, FRAME_RATE, GAIN, Features
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.interface import DeviceError
from fitctl.drivers.probe import Probe, round_trip_s

_ANY_CONTROL = protocol.CONTROL | protocol.CONTROL_EXCLUSIVE
_CONTROLLED = "another program has control of it: a running supervisor, or one to be ended first"
_TOLERANCE = 1e-6  # 1e6 / rate and back is not exact
_WHOLE = {"Width": ("WidthMax", "OffsetX"), "Height": ("HeightMax", "OffsetY")}
_LOAD = ("Width", "Height", "PayloadSize")


def probe_camera(camera: Camera) -> Probe:
    """Read the identity of a camera, and check whether it can be set as in the rig file.

    Raises
    ------
    DeviceError
        If it does not answer, or not as a GigE Vision camera.
    """
    device = camera.device
    channel = ControlChannel(device.address, device.gvcp_port, device.response_timeout_s)
    with closing(channel):
        identity = channel.read_identity()
        question_s = round_trip_s(lambda: channel.read_register(Register.VERSION))
        controlled = channel.read_register(Register.CONTROL_PRIVILEGE)
        problems = [_CONTROLLED] if controlled & _ANY_CONTROL else []
        try:
            problems += _disagreements(Features(channel), camera)
        except DeviceError as error:
            problems.append(str(error))
    return Probe(identity, question_s, tuple(problems))


class _Wanted(NamedTuple):
    """A number of the rig file.

    Attributes
    ----------
    key : str
        Where it is.
    features : tuple of str
        The first of these that the camera has takes it.
    value, units : float
        In the feature's unit, and how many of these are one of the key's.
    lowers : tuple of str
        A higher value of these lowers the feature's maximum.
    """

    key: str
    features: tuple[str, ...]
    value: float
    units: float = 1.0
    lowers: tuple[str, ...] = ()


def _disagreements(features: Features, camera: Camera) -> Iterator[str]:
    """One line for each setting that the camera will refuse, with what to do.

    Some limits hang on other settings: a long exposure allows few frames a second, a large frame fewer
    still. Where the last program has left the camera with more of these than the rig file asks, the limit
    may rise once it is opened, and is not reported.

    Raises
    ------
    DeviceError
        If the camera does not answer, or its description makes no sense.
    """
    device = camera.device
    formats = features.choices("PixelFormat")
    if device.pixel_format not in formats:
        yield (
            f"PixelFormat: camera.device.pixel_format is {device.pixel_format}, the camera has "
            f"{', '.join(formats) or 'none'}; set a format that both have"
        )
    packet_size = ("GevSCPSPacketSize",)
    wanted = (
        _Wanted("camera.width_px", ("Width",), camera.width_px),
        _Wanted("camera.height_px", ("Height",), camera.height_px),
        _Wanted("camera.exposure_s", EXPOSURE, 1e6 * camera.exposure_s, 1e6, FRAME_RATE),
        _Wanted("camera.frame_rate_hz", FRAME_RATE, camera.frame_rate_hz, 1, (*EXPOSURE, *_LOAD)),
        _Wanted("camera.device.gain", GAIN, device.gain),
        _Wanted("camera.device.packet_size_bytes", packet_size, device.packet_size_bytes),
    )
    pixel_bytes = protocol.PIXEL_FORMATS[device.pixel_format].bytes
    shall_be = {name: one.value for one in wanted for name in one.features}
    shall_be["PayloadSize"] = pixel_bytes * camera.width_px * camera.height_px
    without_it_works = {packet_size, GAIN if device.gain == 0 else ()}
    for one in wanted:
        name = features.first_of(one.features)
        if name is not None:
            loaded = any(_above(features, lower, shall_be[lower]) for lower in one.lowers)
            yield from _outside(features, name, one, limited=not loaded)
        elif one.features not in without_it_works:
            yield f"{one.features[0]}: the camera has no such feature, for {one.key}; use another camera"


def _outside(features: Features, name: str, wanted: _Wanted, *, limited: bool) -> Iterator[str]:
    """The disagreement of a number with its feature, if any; `limited` where its maximum stays as it is."""
    limits = features.limits(name)
    if limits is None:
        return
    low, high, step = limits
    if name in _WHOLE:
        high = _whole(features, *_WHOLE[name], high)
    slack = _TOLERANCE * abs(wanted.value)
    too_high = limited and wanted.value > high + slack
    between_steps = step > 1 and (wanted.value - low) % step != 0
    if wanted.value < low - slack or too_high or between_steps:
        steps = f" in steps of {step:g}" if step > 1 else ""
        low_of_key, high_of_key = low / wanted.units, high / wanted.units
        yield (
            f"{name}: {wanted.key} is {wanted.value / wanted.units:g}, the camera takes "
            f"{low_of_key:g} to {high_of_key:g}{steps}; set one of these"
        )


def _whole(features: Features, most: str, offset: str, high: float) -> float:
    """A size's maximum without the offset, which opening the camera sets to 0."""
    if features.limits(most) is not None:
        return max(high, features.value(most))
    return high + features.value(offset) if features.limits(offset) is not None else high


def _above(features: Features, name: str, wanted: float) -> bool:
    """Whether a feature stands higher now than the rig file wants it."""
    readable = features.limits(name) is not None
    return readable and features.value(name) > wanted * (1 + _TOLERANCE)
