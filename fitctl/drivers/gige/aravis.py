"""The same cameras through the library Aravis, for those that its users have made work.

Needs Aravis 0.8 and PyGObject, which are no Python packages of fitctl's: the library is loaded when a
camera is opened, and not before. Source: Aravis' own reference of its GObject interface.
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from fitctl.config import Camera
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.features import (
    EXPOSURE_TOLERANCE,
    GAIN_TOLERANCE,
    RATE_TOLERANCE,
    expect,
    mismatch,
    refused_rate,
)
from fitctl.drivers.gige.gvcp import DEVICE
from fitctl.drivers.gige.heartbeat import Heartbeat
from fitctl.drivers.gige.ticks import CameraTime, mid_exposure_s
from fitctl.drivers.interface import (
    CameraCounts,
    DeviceError,
    DeviceIdentity,
    DeviceMismatch,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
    Frame,
)

_BUFFERS = 16
_SLICE_S = 0.05  # how soon a lost link shows while no frame comes


class AravisCamera:
    """Driver of one camera through Aravis; ``open``, ``start``, ``next_frame`` and the rest from one thread.

    Parameters
    ----------
    camera : Camera
        The rig file's section.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._endpoint = Endpoint(DEVICE, camera.device.endpoint)
        self._expect = partial(expect, self._endpoint)
        self._mismatch = partial(mismatch, self._endpoint)
        self._aravis: Any = None
        self._device: Any = None
        self._stream: Any = None
        self._time: CameraTime | None = None
        self._heartbeat: Heartbeat | None = None
        self._exposure_s = camera.exposure_s
        self._block = 0
        self._counts = CameraCounts(0, 0, 0)
        self._number = 0

    def open(self) -> DeviceIdentity:
        """Take control, set the camera as the rig file says, and keep control from then on.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout
            If the library is not installed, or nothing answers.
        DeviceRefused
            If another program has control.
        DeviceMismatch
            If the camera cannot be set as the rig file says.
        """
        self.close()
        settings = self._camera.device
        if settings.gvcp_port != protocol.GVCP_PORT:
            raise self._mismatch(f"gvcp_port = {protocol.GVCP_PORT}", str(settings.gvcp_port))
        self._aravis = _library(self._endpoint)
        try:
            with self._translated("a GigE Vision camera"):
                self._device = self._aravis.Camera.new(settings.address)
                identity = DeviceIdentity(
                    maker=self._device.get_vendor_name(),
                    model=self._device.get_model_name(),
                    serial=self._device.get_device_serial_number(),
                    firmware=self._device.get_device().get_string_feature_value("DeviceVersion"),
                )
            if not self._device.get_device().is_controller():
                raise self._endpoint.error(
                    DeviceRefused,
                    "control of the camera",
                    "read access only",
                    "another program has it: end that, or wait for its heartbeat to lapse",
                )
            with self._translated("the camera to match the rig file"):
                self._configure()
            registers = _Registers(self._device.get_device(), self._endpoint, self._translated)
            self._time = CameraTime(registers)
            self._heartbeat = Heartbeat(registers, self._time, settings.heartbeat_s)
        except BaseException:
            self.close()
            raise
        return identity

    def start(self) -> None:
        """Start the stream; frame numbers and counts begin anew."""
        self.stop()
        self._opened()
        self._block = self._number = 0
        self._counts = CameraCounts(0, 0, 0)
        with self._translated("the stream to start"):
            stream = self._device.create_stream(None, None)
            for _ in range(_BUFFERS):
                stream.push_buffer(self._aravis.Buffer.new_allocate(self._device.get_payload()))
            self._stream = stream
            self._device.start_acquisition()

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The next complete frame, oldest first; None when none came in time.

        Raises
        ------
        DeviceUnreachable
            If the camera no longer answers, or has taken control away.
        """
        heartbeat = self._opened()
        if self._stream is None:
            raise self._endpoint.error(
                DeviceMismatch, "a started stream", "none", "call start() first"
            )
        deadline_s = time.monotonic() + timeout_s
        while True:
            if heartbeat.error is not None:
                raise heartbeat.error
            left_s = max(0.0, deadline_s - time.monotonic())
            buffer = self._stream.timeout_pop_buffer(int(min(left_s, _SLICE_S) * 1e6))
            if buffer is not None:
                try:
                    frame = self._frame(buffer)
                finally:
                    self._stream.push_buffer(buffer)
                if frame is not None:
                    return frame
            elif left_s == 0.0:
                return None

    def set_frame_rate(self, rate_hz: float) -> None:
        """As :meth:`fitctl.drivers.gige.driver.GigeCamera.set_frame_rate`; it raises the same errors."""
        self._opened()
        with self._translated("the frame rate to be readable"):
            before_hz = self._device.get_frame_rate()
        refusal = ""
        try:
            with self._translated("another frame rate"):
                self._device.set_frame_rate(rate_hz)
        except DeviceMismatch as error:
            refusal = error.got
        with self._translated("the frame rate to be readable"):
            actual_hz = self._device.get_frame_rate()
        if refusal and actual_hz == before_hz:
            raise refused_rate(self._endpoint, rate_hz, refusal)
        self._expect("frame rate", rate_hz, actual_hz, RATE_TOLERANCE)

    def counts(self) -> CameraCounts:
        """Frames and losses so far; may be called from any thread."""
        return self._counts

    def stop(self) -> None:
        """Stop the stream if it runs; a camera that has gone or was taken away is no error here."""
        stream, self._stream = self._stream, None
        if stream is not None and self._answers():
            with contextlib.suppress(DeviceError), self._translated("the stream to stop"):
                self._device.stop_acquisition()

    def close(self) -> None:
        """Stop and give up control; safe to call twice and after a failure."""
        self.stop()
        answers = self._answers()
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.stop()
        self._time = None  # it holds the device
        device, self._device = self._device, None
        if answers:
            with contextlib.suppress(DeviceError), self._translated("control to be given up"):
                device.get_device().leave_control()

    def _configure(self) -> None:
        """As :meth:`fitctl.drivers.gige.features.Features.configure`, in Aravis' words."""
        aravis, device, camera = self._aravis, self._device, self._camera
        settings = camera.device
        device.stop_acquisition()
        device.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
        device.clear_triggers()
        if device.is_exposure_auto_available():
            device.set_exposure_time_auto(aravis.Auto.OFF)
        if device.is_gain_auto_available():
            device.set_gain_auto(aravis.Auto.OFF)
        device.set_region(0, 0, camera.width_px, camera.height_px)
        _x, _y, *size = device.get_region()
        if size != [camera.width_px, camera.height_px]:
            raise self._mismatch(f"{camera.width_px} x {camera.height_px} px", f"{size}")
        device.set_pixel_format_from_string(settings.pixel_format)
        if device.is_gain_available():
            device.set_gain(settings.gain)
            self._expect("gain", settings.gain, device.get_gain(), GAIN_TOLERANCE)
        else:
            self._expect("gain", settings.gain, 0.0, 0.0)
        for _ in range(2):  # exposure and rate limit each other
            device.set_exposure_time(camera.exposure_s * 1e6)
            device.set_frame_rate(camera.frame_rate_hz)
        exposure_us = device.get_exposure_time()
        self._expect("exposure, us", camera.exposure_s * 1e6, exposure_us, EXPOSURE_TOLERANCE)
        self._expect("frame rate", camera.frame_rate_hz, device.get_frame_rate(), RATE_TOLERANCE)
        self._exposure_s = exposure_us / 1e6
        device.gv_set_packet_size_adjustment(aravis.GvPacketSizeAdjustment.NEVER)
        device.gv_set_packet_size(settings.packet_size_bytes)
        size_bytes = device.gv_get_packet_size()
        self._expect("packet_size_bytes", settings.packet_size_bytes, size_bytes, 0.0)
        device.gv_set_packet_delay(round(settings.packet_delay_s * 1e9))

    def _frame(self, buffer: Any) -> Frame | None:
        """A frame of a whole buffer; what Aravis gave up leaves a gap in the numbers."""
        received_s = time.monotonic()
        requests = self._stream.get_info_uint64_by_name("n_resend_requests")
        if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
            return None
        block = buffer.get_frame_id()
        step = 1 if self._block == 0 else protocol.blocks_between(self._block, block)
        self._block = block
        self._number += step
        counts = self._counts
        self._counts = CameraCounts(counts.frames + 1, counts.lost + step - 1, requests)
        pixel_format = protocol.PIXEL_FORMATS[self._camera.device.pixel_format]
        size = buffer.get_image_height(), buffer.get_image_width()
        got = (buffer.get_image_pixel_format() & 0xFFFFFFFF, *size)
        wanted = (pixel_format.code, self._camera.height_px, self._camera.width_px)
        if got != wanted:
            raise self._mismatch(f"frames of format, height, width {wanted}", f"{got}")
        pixels = np.frombuffer(buffer.get_image_data(), f"<u{pixel_format.bytes}")
        image = pixels[: size[0] * size[1]].reshape(size).astype(np.uint16)
        ticks = round(buffer.get_timestamp() * (self._time.ticks_per_s if self._time else 0) / 1e9)
        middle_s = mid_exposure_s(self._time, self._camera, self._exposure_s, ticks, received_s)
        return Frame(self._number, middle_s, received_s, image)

    def _answers(self) -> bool:
        """Whether the camera still answers; if not, Aravis would retry for seconds."""
        lost = self._heartbeat is not None and self._heartbeat.error is not None
        return self._device is not None and not lost

    def _opened(self) -> Heartbeat:
        if self._device is None or self._heartbeat is None:
            raise self._endpoint.not_open()
        return self._heartbeat

    @contextlib.contextmanager
    def _translated(self, expected: str) -> Iterator[None]:
        """Aravis' errors as ours."""
        glib = importlib.import_module("gi.repository.GLib")
        try:
            yield
        except glib.Error as error:
            codes = self._aravis.DeviceError
            kind = {codes.TIMEOUT: DeviceTimeout, codes.NOT_FOUND: DeviceUnreachable}.get(
                error.code, DeviceMismatch
            )
            raise self._endpoint.error(
                kind,
                expected,
                error.message,
                "check power, cable and [camera] in the rig file",
            ) from error


class _Registers:
    """The registers of an Aravis device, for what watches the camera's clock and control."""

    def __init__(
        self,
        device: Any,
        endpoint: Endpoint,
        translated: Callable[[str], contextlib.AbstractContextManager[None]],
    ) -> None:
        self.endpoint = endpoint
        self.answered_s = time.monotonic()
        self._device = device
        self._translated = translated

    def read_register(self, address: int) -> int:
        """Read one 32-bit register."""
        with self._translated(f"register 0x{address:08X} to be readable"):
            value = self._device.read_register(address)
        self.answered_s = time.monotonic()
        return int(value)

    def write_register(self, address: int, value: int) -> None:
        """Write one 32-bit register."""
        with self._translated(f"register 0x{address:08X} to take {value}"):
            self._device.write_register(address, value)
        self.answered_s = time.monotonic()


def _library(endpoint: Endpoint) -> Any:
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:
        raise endpoint.error(
            DeviceUnreachable,
            "the library Aravis 0.8 and PyGObject",
            str(error),
            "install them (Debian: gir1.2-aravis-0.8 python3-gi) for the Python that runs fitctl, "
            'or set camera.device.driver = "gige" in the rig file',
        ) from error
