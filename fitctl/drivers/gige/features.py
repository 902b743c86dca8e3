"""The camera's features by name, through its own GenICam description."""

from __future__ import annotations

import contextlib
import importlib
import io
import zipfile
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

from fitctl.config import Camera
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.protocol import MalformedPacketError, Register
from fitctl.drivers.interface import DeviceMismatch, DeviceProtocolError, DeviceRefused

RATE_TOLERANCE = 1e-3  # cameras round the frame rate to their own clock
EXPOSURE_TOLERANCE = 1e-2  # and the exposure to rows or microseconds
GAIN_TOLERANCE = 1e-2

# Set where a camera has them, before anything else: free running, nothing automatic.
_FREE_RUNNING = (
    ("AcquisitionMode", "Continuous"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("AcquisitionFrameRateAuto", "Off"),
    ("AcquisitionFrameRateEnable", True),
    ("AcquisitionFrameRateEnabled", True),
    ("ChunkModeActive", False),
    ("GevGVSPExtendedIDMode", "Off"),
)
EXPOSURE = ("ExposureTime", "ExposureTimeAbs")  # microseconds; the second name is SFNC 1
FRAME_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
GAIN = ("Gain", "GainRaw", "GainAbs")


class Limits(NamedTuple):
    """What a feature may be, in its own unit; a step of 0 is none."""

    low: float
    high: float
    step: int


class Features:
    """A camera's GenICam node map over its control channel.

    Parameters
    ----------
    channel : ControlChannel
        Connected, and with control of the camera for anything that writes.

    Raises
    ------
    DeviceMismatch
        If the camera keeps no usable description in its memory.
    """

    def __init__(self, channel: ControlChannel) -> None:
        # Loads a large shared library: here, so that commands without a camera start fast.
        genapi: Any = importlib.import_module("genicam.genapi")

        class Port(genapi.AbstractPort):
            """Gives the node map the camera's registers; errors pass through it as they are."""

            def read(self, address: int, length: int) -> bytes:
                if length == 4:
                    return protocol.encode_words(channel.read_register(address))
                return channel.read_memory(address, length)

            def write(self, address: int, data: bytes) -> None:
                if len(data) == 4:
                    channel.write_register(address, int.from_bytes(data, "big"))
                else:
                    channel.write_memory(address, bytes(data))

            def get_access_mode(self) -> int:
                return int(genapi.EAccessMode.RW)

            def is_open(self) -> bool:
                return True

        self._endpoint = channel.endpoint
        self._expect = partial(expect, channel.endpoint)
        self._mismatch = partial(mismatch, channel.endpoint)
        self._errors: type[Exception] = genapi.GenericException
        self._integer: type[Any] = genapi.IInteger
        self._readable = {genapi.EAccessMode.RW, genapi.EAccessMode.RO}
        self._writable = {genapi.EAccessMode.RW, genapi.EAccessMode.WO}
        self._port = Port()  # the node map does not keep it alive
        self._nodes = genapi.NodeMap()
        xml = download_xml(channel)
        try:
            self._nodes.load_xml_from_string(xml)
            self._nodes.connect(self._port, "Device")
        except self._errors as error:
            raise self._mismatch("a GenICam description", str(error)) from error

    def configure(self, camera: Camera) -> float:
        """Apply the settings of the rig file and check that the camera has accepted them.

        Returns
        -------
        float
            The exposure in seconds, as the camera has rounded it.

        Raises
        ------
        DeviceMismatch
            If the camera lacks a feature or will not have the value.
        """
        for name, value in _FREE_RUNNING:
            self._set_if_writable(name, value)
        self._switch_triggers_off()
        self._set_if_writable("OffsetX", 0)
        self._set_if_writable("OffsetY", 0)
        for name, wanted in (("Width", camera.width_px), ("Height", camera.height_px)):
            self._set(name, wanted)
            self._expect(name, wanted, self.value(name), tolerance=0.0)
        self._set("PixelFormat", camera.device.pixel_format)
        pixel_bytes = protocol.PIXEL_FORMATS[camera.device.pixel_format].bytes
        payload_bytes = pixel_bytes * camera.width_px * camera.height_px
        self._expect("PayloadSize", payload_bytes, self.value("PayloadSize"), tolerance=0.0)
        self._set_gain(camera.device.gain)
        return self._set_timing(camera)

    def set_frame_rate(self, rate_hz: float) -> None:
        """Set only the frame rate; the camera may be streaming.

        Raises
        ------
        DeviceRefused
            If the camera will not have the value, and keeps the one it has.
        DeviceMismatch
            If it has taken another.
        """
        rate = self._needed(FRAME_RATE)
        try:
            self._set(rate, rate_hz)
        except DeviceMismatch as error:
            raise refused_rate(self._endpoint, rate_hz, error.got) from error
        try:
            actual_hz = self.value(rate)
        except DeviceRefused as error:  # of the read: the rate may have changed
            raise self._mismatch(f"{rate} to be readable", error.got) from error
        self._expect(rate, rate_hz, actual_hz, RATE_TOLERANCE)

    def first_of(self, names: tuple[str, ...]) -> str | None:
        """Which of a feature's names the camera knows; None where it knows none."""
        return next(filter(self._nodes.has_node, names), None)

    def value(self, name: str) -> Any:
        """The value in the camera, not the one that the node map remembers.

        Raises
        ------
        DeviceMismatch
            If it cannot be read.
        """
        with self._read(name) as node:
            return node.get_value(False, True)

    def limits(self, name: str) -> Limits | None:
        """What a number may be, as the camera is set now; None where it has no such number to read.

        Raises
        ------
        DeviceMismatch
            If its description makes no sense.
        """
        if not self._nodes.has_node(name):
            return None
        with self._read(name) as node:
            if node.get_access_mode() not in self._readable:
                return None
            return Limits(node.min, node.max, node.inc if isinstance(node, self._integer) else 0)

    def choices(self, name: str) -> list[str]:
        """The entries of an enumeration that the camera has.

        Raises
        ------
        DeviceMismatch
            If it has no such enumeration.
        """
        with self._read(name) as node:
            return [
                entry.symbolic
                for entry in node.entries
                if entry.get_access_mode() in self._readable
            ]

    def start(self) -> None:
        """Lock the transport parameters and start the acquisition."""
        self._set_if_writable("TLParamsLocked", 1)
        self._execute("AcquisitionStart")

    def stop(self) -> None:
        """Stop the acquisition and unlock the transport parameters."""
        self._execute("AcquisitionStop")
        self._set_if_writable("TLParamsLocked", 0)

    def _switch_triggers_off(self) -> None:
        """Each of them: `TriggerMode` is that of the one selected."""
        selectors: tuple[str, ...] = ()
        if self._nodes.has_node("TriggerSelector"):
            with self._read("TriggerSelector") as node:
                selectors = node.symbolics
        for selector in selectors:
            self._set_if_writable("TriggerSelector", selector)
            self._set_if_writable("TriggerMode", "Off")
        self._set_if_writable("TriggerMode", "Off")

    def _set_gain(self, wanted: float) -> None:
        """A camera without a gain to set has none."""
        name = self.first_of(GAIN)
        if name is None:
            self._expect("Gain", wanted, 0.0, tolerance=0.0)
            return
        self._set_if_writable(name, round(wanted) if name == "GainRaw" else wanted)
        self._expect(name, wanted, self.value(name), GAIN_TOLERANCE)

    def _set_timing(self, camera: Camera) -> float:
        """Exposure and frame rate limit each other: go first the way that always fits."""
        exposure = self._needed(EXPOSURE)
        rate = self._needed(FRAME_RATE)
        exposure_us = camera.exposure_s * 1e6
        steps = [(exposure, exposure_us), (rate, camera.frame_rate_hz)]
        if exposure_us > self.value(exposure):
            steps.reverse()
        for name, value in steps:
            self._set(name, value)
        actual_us = float(self.value(exposure))
        self._expect(exposure, exposure_us, actual_us, EXPOSURE_TOLERANCE)
        self._expect(rate, camera.frame_rate_hz, self.value(rate), RATE_TOLERANCE)
        return actual_us / 1e6

    def _needed(self, names: tuple[str, ...]) -> str:
        name = self.first_of(names)
        if name is None:
            raise self._mismatch(f"feature {names[0]}", "a camera without it")
        return name

    def _set(self, name: str, value: float | str | bool) -> None:
        try:
            self._nodes.get_node(name).value = value
        except (self._errors, DeviceRefused) as error:
            raise self._mismatch(f"{name} = {value}", str(error)) from error

    def _set_if_writable(self, name: str, value: float | str | bool) -> None:
        """Set a feature that not every camera has, or has fixed."""
        if self._nodes.has_node(name):
            with self._read(name) as node:
                writable = node.get_access_mode() in self._writable
            if writable:
                self._set(name, value)

    @contextlib.contextmanager
    def _read(self, name: str) -> Iterator[Any]:
        try:
            yield self._nodes.get_node(name)
        except self._errors as error:
            raise self._mismatch(f"feature {name} to be readable", str(error)) from error

    def _execute(self, name: str) -> None:
        try:
            self._nodes.get_node(name).execute()
        except self._errors as error:
            raise self._mismatch(f"command {name}", str(error)) from error


_XML_BYTES_MAX = 16 << 20  # many times that of any known camera; 4 GiB would be read for hours
_MEMORY_END = 1 << 32


def download_xml(channel: ControlChannel) -> str:
    """The description from the camera's memory, by its first URL or else its second.

    Raises
    ------
    DeviceMismatch
        If the camera keeps none in its memory, or an absurd one.
    DeviceProtocolError
        If it cannot be unpacked.
    """
    urls = []
    for register in (Register.XML_URL_1, Register.XML_URL_2):
        text = channel.read_text(protocol.TextRegister(register, protocol.XML_URL_BYTES))
        urls.append(text)
        try:
            location = protocol.decode_xml_url(text)
        except MalformedPacketError:
            continue
        if not 0 < location.length <= min(_XML_BYTES_MAX, _MEMORY_END - location.address):
            continue
        data = channel.read_memory(location.address, location.length)
        return unpacked(data, channel.endpoint)
    raise channel.endpoint.error(
        DeviceMismatch,
        "a GenICam description of 1 byte to 16 MiB in the camera's memory, Local:NAME;ADDRESS;LENGTH",
        " and ".join(repr(url) for url in urls),
        "fitctl cannot read a description kept elsewhere; update the camera's firmware",
    )


def unpacked(data: bytes, endpoint: Endpoint) -> str:
    """The text of a description: most real cameras send a zip archive that holds the one file.

    Raises
    ------
    DeviceProtocolError
        If it is damaged or absurdly large.
    """
    try:
        if data.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                first = archive.infolist()[0]
                if first.file_size > _XML_BYTES_MAX:
                    msg = f"{first.file_size} bytes once unpacked"
                    raise ValueError(msg)
                with archive.open(first) as packed:
                    # One byte more, for its checksum to be compared; `archive.read` would unpack
                    # all that there is, whatever the directory says.
                    data = packed.read(first.file_size + 1)
        text = data.rstrip(b"\0").decode("utf-8-sig")
        # No camera needs one; its entities could make gigabytes of a few kilobytes, or name files.
        if "<!DOCTYPE" in text:
            msg = "it declares a document type"
            raise ValueError(msg)
        return text
    except Exception as error:  # a damaged archive can raise any of a dozen kinds
        raise endpoint.error(
            DeviceProtocolError,
            "a readable GenICam description",
            f"{type(error).__name__}: {error}",
            "update its firmware",
        ) from error


def expect(endpoint: Endpoint, name: str, wanted: float, actual: float, tolerance: float) -> None:
    """See that a camera has taken a number. Raises DeviceMismatch."""
    if abs(actual - wanted) > tolerance * abs(wanted):
        raise mismatch(endpoint, f"{name} = {wanted:g}", f"{actual:g}")


def refused_rate(endpoint: Endpoint, rate_hz: float, got: str) -> DeviceRefused:
    """The error for a camera that refuses another frame rate while it streams."""
    return endpoint.error(
        DeviceRefused,
        f"{rate_hz:g} frames/s from now on",
        got,
        "some cameras keep their rate while they take frames",
    )


def mismatch(endpoint: Endpoint, expected: str, got: str) -> DeviceMismatch:
    """The error for a camera that does not match the rig file."""
    return endpoint.error(
        DeviceMismatch, expected, got, "correct [camera] in the rig file to this camera"
    )
