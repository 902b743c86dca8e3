from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from gige_served import IMAGE, Served, camera_settings, mock_settings, received
from numpy.typing import NDArray

from fitctl.config import Camera
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol, transport
from fitctl.drivers.gige.discovery import discover
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import (
    DeviceError,
    DeviceMismatch,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

Serve = Callable[..., Served]
Connect = Callable[..., GigeCamera]


def drain(camera: GigeCamera) -> None:
    while camera.next_frame(5.0):
        pass


def test_the_image_arrives_bit_for_bit(serve: Serve, connect: Connect) -> None:
    camera = connect(serve())
    camera.start()
    (frame,) = received(camera, 1)
    np.testing.assert_array_equal(frame.image, IMAGE)
    assert frame.image.dtype == np.uint16


def test_an_image_of_many_packets_arrives_bit_for_bit(serve: Serve, connect: Connect) -> None:
    size = {"width_px": 200, "height_px": 123}
    image = np.random.default_rng(2).integers(0, 65536, (123, 200), dtype=np.uint16)
    camera = connect(serve(lambda _: image, **size), packet_size_bytes=576, **size)
    camera.start()
    (frame,) = received(camera, 1)
    np.testing.assert_array_equal(frame.image, image)


@pytest.mark.parametrize(("pixel_format", "shift"), [("Mono8", 8), ("Mono12", 4)])
def test_other_pixel_formats_arrive_as_the_numbers_that_the_camera_counts(
    serve: Serve, connect: Connect, pixel_format: str, shift: int
) -> None:
    camera = connect(serve(), pixel_format=pixel_format)
    camera.start()
    (frame,) = received(camera, 1)
    np.testing.assert_array_equal(frame.image, IMAGE >> shift)
    assert frame.image.dtype == np.uint16


def test_the_gain_is_set(serve: Serve, connect: Connect) -> None:
    camera = connect(serve(lambda _: np.full((40, 40), 1000, np.uint16)), gain=20.0)
    camera.start()
    (frame,) = received(camera, 1)
    assert np.all(frame.image == 10000)


@pytest.mark.parametrize("description", ["xml", "zip"])
def test_the_description_is_read_plain_or_zipped(
    serve: Serve, connect: Connect, description: str
) -> None:
    connect(serve(mock=mock_settings(description=description)))


def test_a_delay_between_packets_is_set_and_kept(serve: Serve, connect: Connect) -> None:
    camera = connect(serve(), packet_delay_s=0.003)  # leader, three of pixels, trailer
    camera.start()
    for frame in received(camera, 3):
        assert frame.received_s - frame.mid_exposure_s >= 0.034 + 3 * 0.003


def test_a_delay_that_no_clock_can_count_is_a_mismatch(serve: Serve, connect: Connect) -> None:
    with pytest.raises(DeviceMismatch, match=r"0\.001 s between packets.*without a clock"):
        connect(serve(mock=mock_settings(clock=False)), packet_delay_s=0.001)


def test_so_is_one_that_a_fast_clock_cannot_count() -> None:
    class Channel:
        endpoint = Endpoint("camera", "127.0.0.1:3956")
        written: ClassVar[list[int]] = []

        def write_register(self, _address: int, value: int) -> None:
            self.written.append(value)

    with pytest.raises(DeviceMismatch, match=r"0\.01 s between packets.*1000000000000 Hz"):
        transport.set_packet_delay(Channel(), 0.01, 10**12)
    assert all(value < 2**32 for value in Channel.written)


def test_an_address_that_the_host_no_longer_has_is_named() -> None:
    class Channel:
        endpoint = Endpoint("camera", "192.0.2.2:3956")
        local_address = "192.0.2.1"

    with pytest.raises(DeviceUnreachable, match=r"receive at 192\.0\.2\.1.*network interface"):
        transport.open_stream(Channel())


def test_a_test_packet_that_the_kernel_drops_when_it_is_read_has_not_arrived() -> None:
    """Linux reports a datagram with a wrong checksum as one to read, and then has none."""

    class Channel:
        def write_register(self, _address: int, _value: int) -> None:
            pass

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    theirs.send(bytes(1472))

    class Stream:
        fileno = ours.fileno

        def recv(self, count: int) -> bytes:
            ours.recv(count)
            raise BlockingIOError

    assert not transport._arrives(Channel(), Stream(), 1500)
    ours.close()
    theirs.close()


def test_a_camera_is_discovered(serve: Serve) -> None:
    served = serve()
    (found,) = discover("127.0.0.1", 0.3, port=served.port)
    assert (found.address, found.mac) == ("127.0.0.1", "02:00:00:00:00:01")
    assert (found.identity.model, found.identity.serial) == ("MockCamera", "FIT01")


def test_nobody_is_discovered_where_nobody_is() -> None:
    with pytest.raises(DeviceUnreachable, match="broadcast address"):
        discover("camera.invalid..", 0.1)


def test_the_frame_carries_the_middle_of_its_exposure(serve: Serve, connect: Connect) -> None:
    rendered: list[float] = []

    def render(mid_exposure_s: float) -> NDArray[np.uint16]:
        rendered.append(mid_exposure_s)
        return IMAGE

    camera = connect(serve(render))
    camera.start()
    taken = received(camera, 10)
    for frame in taken:
        assert frame.mid_exposure_s == pytest.approx(rendered[frame.number - 1], abs=1e-3)
        assert frame.received_s - frame.mid_exposure_s >= 0.034  # frame_delay_s, less the clocks
    assert [b.number - a.number for a, b in pairwise(taken)] == [1] * 9


def test_the_frame_rate_changes_while_frames_come(serve: Serve, connect: Connect) -> None:
    camera = connect(serve())
    camera.start()
    received(camera, 3)
    camera.set_frame_rate(25.0)
    slower = received(camera, 8)[-4:]
    camera.set_frame_rate(50.0)
    usual = received(camera, 8)[-4:]

    for frames, period_s in ((slower, 0.04), (usual, 0.02)):
        apart_s = np.diff([frame.mid_exposure_s for frame in frames])
        assert apart_s == pytest.approx(period_s, rel=0.02)
    assert camera.counts().lost == 0


def test_a_frame_rate_that_does_not_fit_is_refused_and_the_camera_keeps_its_own(
    serve: Serve, connect: Connect
) -> None:
    camera = connect(serve())
    camera.start()
    with pytest.raises(DeviceRefused, match=r"expected 1e\+06 frames/s from now on"):
        camera.set_frame_rate(1e6)
    apart_s = np.diff([frame.mid_exposure_s for frame in received(camera, 5)])

    assert apart_s == pytest.approx(0.02, rel=0.02)


def test_a_closed_camera_has_no_frame_rate(serve: Serve, connect: Connect) -> None:
    camera = connect(serve())
    camera.close()
    with pytest.raises(DeviceUnreachable):
        camera.set_frame_rate(25.0)


def test_frames_of_a_camera_without_a_clock_are_as_old_as_the_rig_file_says(
    serve: Serve, connect: Connect
) -> None:
    camera = connect(serve(mock=mock_settings(clock=False)), frame_delay_s=0.03)
    camera.start()
    (frame,) = received(camera, 1)
    assert frame.received_s - frame.mid_exposure_s == pytest.approx(0.03)


def test_the_identity_is_what_the_camera_says(serve: Serve) -> None:
    camera = GigeCamera(camera_settings(gvcp_port=serve().port))
    identity = camera.open()
    camera.close()
    assert (identity.maker, identity.model, identity.serial) == ("FIT", "MockCamera", "FIT01")


def test_frames_after_a_new_start_are_new(serve: Serve, connect: Connect) -> None:
    camera = connect(serve())
    for _ in range(2):
        camera.start()
        started_s = time.monotonic()
        (frame,) = received(camera, 1)
        assert frame.number == 1
        assert frame.mid_exposure_s > started_s - 0.05
        camera.stop()


def test_a_second_program_is_refused_until_the_first_lets_go(
    serve: Serve, connect: Connect
) -> None:
    served = serve()
    first = connect(served)
    with pytest.raises(DeviceRefused, match=r"control of the camera.*0x8006 ACCESS_DENIED"):
        connect(served)
    first.close()
    connect(served)


def test_control_lapses_and_the_stream_ends_without_a_heartbeat(serve: Serve) -> None:
    served = serve()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(2)
        client.connect(("127.0.0.1", served.port))
        for register, value in (
            (protocol.Register.CONTROL_PRIVILEGE, protocol.CONTROL),
            (protocol.Register.HEARTBEAT_TIMEOUT_MS, 500),
            (0xA01C, 1),  # acquisition start
        ):
            words = protocol.encode_words(register, value)
            client.send(protocol.encode_command(protocol.Command.WRITEREG, 1, words))
            assert protocol.decode_answer(client.recv(2048)).status == protocol.Status.SUCCESS
    assert served.call(lambda: served.mock.acquisition.running)
    deadline_s = time.monotonic() + 5
    while served.call(lambda: served.mock.acquisition.running):
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.02)
    camera = GigeCamera(camera_settings(gvcp_port=served.port))
    camera.open()  # control is free again
    camera.close()


def test_the_driver_keeps_control_for_longer_than_a_heartbeat(
    serve: Serve, connect: Connect
) -> None:
    camera = connect(serve(), heartbeat_s=0.5)
    camera.start()
    assert len(received(camera, 50)) == 50


def test_a_camera_that_has_gone_is_noticed_at_once(serve: Serve, connect: Connect) -> None:
    served = serve()
    camera = connect(served)
    camera.start()
    received(camera, 2)
    served.stop()
    gone_s = time.monotonic()
    with pytest.raises(DeviceUnreachable, match=f"camera at 127.0.0.1:{served.port}"):
        drain(camera)
    assert time.monotonic() - gone_s < 0.5
    camera.stop()
    camera.close()
    camera.close()


def test_control_taken_away_is_noticed(serve: Serve, connect: Connect) -> None:
    served = serve()
    camera = connect(served)
    camera.start()
    served.call(served.mock._release_control)
    with pytest.raises(DeviceUnreachable, match="a camera that has ended it"):
        drain(camera)


def test_a_camera_can_be_opened_again_after_it_came_back(serve: Serve, connect: Connect) -> None:
    camera = connect(serve())
    camera.close()
    camera.open()
    camera.start()
    assert len(received(camera, 2)) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width_px": 64}, "Width = 64"),
        ({"height_px": 48}, "Height = 48"),
        ({"packet_size_bytes": 1501}, "packets of 1501 bytes, got 0x8002"),
        ({"gain": 30.0}, "Gain = 30"),
    ],
)
def test_a_camera_that_cannot_be_what_the_rig_file_says_is_named(
    serve: Serve, connect: Connect, changes: dict[str, float], message: str
) -> None:
    served = serve()
    with pytest.raises(DeviceMismatch, match=message):
        connect(served, **changes)
    connect(served)  # and the failed attempt has let go of control


@pytest.mark.parametrize(("rate_hz", "exposure_s"), [(5.0, 0.2), (500.0, 0.002), (2000.0, 1e-4)])
def test_exposure_and_rate_are_set_whichever_limits_the_other(
    serve: Serve, connect: Connect, rate_hz: float, exposure_s: float
) -> None:
    camera = connect(serve(), frame_rate_hz=rate_hz, exposure_s=exposure_s)
    camera.start()
    first, second = received(camera, 2)
    step_s = (second.mid_exposure_s - first.mid_exposure_s) / (second.number - first.number)
    assert step_s == pytest.approx(1 / rate_hz, abs=1e-3)


def test_nobody_at_the_endpoint_is_unreachable() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    camera = GigeCamera(camera_settings(gvcp_port=port))
    with pytest.raises(DeviceUnreachable, match="start the mocks"):
        camera.open()
    camera.close()


def test_silence_at_the_endpoint_is_a_timeout() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        settings = camera_settings(gvcp_port=silent.getsockname()[1], response_timeout_s=0.15)
        with pytest.raises(DeviceTimeout, match="none to 3 attempts"):
            GigeCamera(settings).open()


def test_a_closed_camera_gives_no_frames() -> None:
    camera = GigeCamera(camera_settings())
    with pytest.raises(DeviceError, match="open"):
        camera.next_frame(0.0)
    camera.stop()
    camera.close()
    assert camera.counts().frames == 0


def test_nothing_is_left_behind(serve: Serve) -> None:
    settings: Camera = camera_settings(gvcp_port=serve().port)
    before = threading.active_count()
    camera = GigeCamera(settings)
    camera.open()
    camera.start()
    camera.close()
    assert threading.active_count() == before
