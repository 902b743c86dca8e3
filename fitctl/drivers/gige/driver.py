"""A GigE Vision camera as the supervisor uses it."""

from __future__ import annotations

import contextlib
import select
import socket
import time

from fitctl.config import Camera
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.features import Features
from fitctl.drivers.gige.gvcp import DEVICE, ControlChannel
from fitctl.drivers.gige.heartbeat import Heartbeat
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.gige.stream import CompleteFrame, FrameAssembler
from fitctl.drivers.gige.ticks import CameraTime, mid_exposure_s
from fitctl.drivers.gige.transport import (
    check_path,
    open_stream,
    set_packet_delay,
    set_packet_size,
)
from fitctl.drivers.interface import (
    CameraCounts,
    DeviceError,
    DeviceIdentity,
    DeviceMismatch,
    DeviceRefused,
    Frame,
)

_PACKET_BYTES_MAX = 65536
_DRAIN_S = 0.05  # how far past its time limit a call goes on while packets keep coming


class GigeCamera:
    """Driver of one camera; ``open``, ``start``, ``next_frame`` and the rest from one thread.

    Parameters
    ----------
    camera : Camera
        The rig file's section.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._channel: ControlChannel | None = None
        self._features: Features | None = None
        self._stream: socket.socket | None = None
        self._assembler: FrameAssembler | None = None
        self._time: CameraTime | None = None
        self._exposure_s = camera.exposure_s
        self._packet = bytearray(_PACKET_BYTES_MAX)
        self._poll = select.poll()
        self._heartbeat: Heartbeat | None = None

    def open(self) -> DeviceIdentity:
        """Take control, set the camera as the rig file says, and keep control from then on.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout
            If nothing answers.
        DeviceRefused
            If another program has control.
        DeviceMismatch
            If the camera cannot be set as the rig file says.
        """
        self.close()
        device = self._camera.device
        channel = ControlChannel(device.address, device.gvcp_port, device.response_timeout_s)
        self._channel = channel
        try:
            _take_control(channel, device.heartbeat_s)
            identity = channel.read_identity()
            self._features = Features(channel)
            self._features.stop()  # whatever the last program has left running
            self._exposure_s = self._features.configure(self._camera)
            set_packet_size(channel, device.packet_size_bytes)
            check_path(channel, device.packet_size_bytes)
            self._time = CameraTime(channel)
            set_packet_delay(channel, device.packet_delay_s, self._time.ticks_per_s)
            self._heartbeat = Heartbeat(channel, self._time, device.heartbeat_s)
        except BaseException:
            self.close()
            raise
        return identity

    def start(self) -> None:
        """Start the stream; frame numbers and counts begin anew."""
        self.stop()
        channel, features, heartbeat = self._opened()
        stream = open_stream(channel)  # on a port of its own: no packet of an earlier one gets in
        self._stream = stream
        self._poll = select.poll()
        self._poll.register(stream, select.POLLIN)
        self._poll.register(heartbeat.wake_fd, select.POLLIN)
        self._assembler = FrameAssembler(
            self._camera.width_px,
            self._camera.height_px,
            protocol.PIXEL_FORMATS[self._camera.device.pixel_format],
            self._camera.device.packet_size_bytes,
            channel.endpoint,
            channel.request_resend,
        )
        features.start()

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The next complete frame, oldest first; None when none came in time.

        Raises
        ------
        DeviceUnreachable
            If the camera no longer answers, or has taken control away.
        """
        channel, _features, heartbeat = self._opened()
        stream, assembler = self._stream, self._assembler
        if stream is None or assembler is None:
            raise channel.endpoint.error(
                DeviceMismatch, "a started stream", "none", "call start() first"
            )
        deadline_s = time.monotonic() + timeout_s
        view = memoryview(self._packet)
        while True:
            if heartbeat.error is not None:
                raise heartbeat.error
            while length := _receive(stream, self._packet):
                complete = assembler.add(view[:length])
                if complete is not None:
                    return self._dated(complete)
                if time.monotonic() > deadline_s + _DRAIN_S:
                    return None
            wake_s = deadline_s
            ask_s = assembler.ask_again()
            if ask_s is not None:
                wake_s = min(wake_s, ask_s)
            now_s = time.monotonic()
            if now_s >= deadline_s:
                return None
            self._poll.poll(max(0.0, wake_s - now_s) * 1000)

    def set_frame_rate(self, rate_hz: float) -> None:
        """Take frames at another rate from now on; also while another thread waits for one.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout
            If the camera is closed, or no longer answers.
        DeviceRefused
            If the camera will not have this rate, and keeps the one it has.
        DeviceMismatch
            If it has taken another.
        """
        _channel, features, _heartbeat = self._opened()
        features.set_frame_rate(rate_hz)

    def counts(self) -> CameraCounts:
        """Frames and losses so far; may be called from any thread."""
        assembler = self._assembler
        if assembler is None:
            return CameraCounts(0, 0, 0)
        return CameraCounts(assembler.frames, assembler.lost, assembler.packets_lost)

    def stop(self) -> None:
        """Stop the stream if it runs; a camera that has gone or was taken away is no error here."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        stream.close()
        channel, features, heartbeat = self._opened()
        if heartbeat.error is None:
            with contextlib.suppress(DeviceError):
                features.stop()
                channel.write_register(Register.STREAM_PORT, 0)

    def close(self) -> None:
        """Stop, give up control, close the sockets; safe to call twice and after a failure."""
        with contextlib.suppress(DeviceError):
            self.stop()
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.stop()
        self._features = None  # before its channel
        channel, self._channel = self._channel, None
        if channel is not None:
            with contextlib.suppress(DeviceError):
                if heartbeat is None or heartbeat.error is None:
                    channel.write_register(Register.CONTROL_PRIVILEGE, 0)
                else:
                    channel.release_unheard()
            channel.close()

    def _dated(self, complete: CompleteFrame) -> Frame:
        received_s = time.monotonic()
        ticks = complete.leader.timestamp_ticks
        middle_s = mid_exposure_s(self._time, self._camera, self._exposure_s, ticks, received_s)
        return Frame(complete.number, middle_s, received_s, complete.image)

    def _opened(self) -> tuple[ControlChannel, Features, Heartbeat]:
        if self._channel is None or self._features is None or self._heartbeat is None:
            raise Endpoint(DEVICE, self._camera.device.endpoint).not_open()
        return self._channel, self._features, self._heartbeat


def _receive(stream: socket.socket, packet: bytearray) -> int:
    """The length of the packet received, 0 when there is none."""
    try:
        return stream.recv_into(packet)
    except BlockingIOError:
        return 0


def _take_control(channel: ControlChannel, heartbeat_s: float) -> None:
    try:
        channel.write_register(Register.CONTROL_PRIVILEGE, protocol.CONTROL)
    except DeviceRefused as error:
        raise channel.endpoint.error(
            DeviceRefused,
            "control of the camera",
            error.got,
            "another program has it: end that, or wait for its heartbeat to lapse",
        ) from error
    channel.write_register(Register.HEARTBEAT_TIMEOUT_MS, round(heartbeat_s * 1000))
