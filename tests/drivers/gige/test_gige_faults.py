"""What the driver makes of everything that can be wrong with the camera: an error or a sound frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from gige_served import IMAGE, Served, received

from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import DeviceError, DeviceMismatch, DeviceUnreachable
from fitctl.mocks.gige.camera import FAULTS
from fitctl.mocks.gige.picture import HOT_PIXEL

FAST = {"frame_rate_hz": 200.0, "exposure_s": 0.002, "heartbeat_s": 0.5, "response_timeout_s": 0.3}
FLAT = np.full((40, 40), 1000, np.uint16)
STAR = FLAT.copy()
STAR[20, 24] = 9000

Serve = Callable[..., Served]
Connect = Callable[..., GigeCamera]


def running(serve: Serve, connect: Connect, image=IMAGE, **changes) -> tuple[Served, GigeCamera]:
    served = serve(lambda _: image)
    camera = connect(served, **FAST | changes)
    camera.start()
    return served, camera


def image_after(camera: GigeCamera, when_s: float) -> np.ndarray:
    """That of a frame exposed after `when_s`, as signed numbers."""
    while (frame := received(camera, 1)[0]).mid_exposure_s < when_s:
        pass
    return frame.image.astype(int)


def until_error(camera: GigeCamera) -> DeviceError:
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s:
        try:
            camera.next_frame(1.0)
        except DeviceError as error:
            return error
    pytest.fail("no error in ten seconds")


@pytest.mark.parametrize("kind", ["drop", "corrupt", "disconnect", "freeze"])
def test_a_camera_that_falls_silent_is_unreachable_once_its_heartbeat_is_over(
    serve: Serve, connect: Connect, kind: str
) -> None:
    served, camera = running(serve, connect)
    received(camera, 3)
    served.fault(kind)
    begun_s = time.monotonic()
    error = until_error(camera)
    assert isinstance(error, DeviceUnreachable)
    assert "READREG" in str(error)
    assert time.monotonic() - begun_s > 0.4
    served.mend()
    camera.open()  # nothing is left of it
    camera.start()
    assert received(camera, 1)[0].number == 1


@pytest.mark.parametrize("kind", ["disconnect", "freeze"])
def test_a_short_silence_is_a_gap_in_the_numbers(serve: Serve, connect: Connect, kind: str) -> None:
    served, camera = running(serve, connect)
    (before,) = received(camera, 1)
    served.fault(kind, for_s=0.1)
    frames = received(camera, 60)
    lost = frames[-1].number - before.number - 60
    assert lost >= 10
    assert camera.counts().lost == lost
    for frame in frames:
        np.testing.assert_array_equal(frame.image, IMAGE)


def test_a_camera_that_restarts_has_taken_control_away_and_can_be_opened_again(
    serve: Serve, connect: Connect
) -> None:
    served, camera = running(serve, connect)
    received(camera, 3)
    served.fault("reboot", value=0.2)
    error = until_error(camera)
    assert isinstance(error, DeviceUnreachable)
    assert "the camera restarted" in str(error)
    camera.open()
    camera.start()
    (frame,) = received(camera, 1)
    assert frame.number == 1
    assert abs(frame.received_s - frame.mid_exposure_s) < 0.5  # by the clock that began anew


@pytest.mark.parametrize("kind", ["drop", "corrupt", "packet_loss"])
def test_lost_packets_are_healed_and_counted(serve: Serve, connect: Connect, kind: str) -> None:
    served, camera = running(serve, connect, frame_rate_hz=50.0)
    served.fault(kind, probability=0.1)
    frames = received(camera, 40)
    for frame in frames:
        np.testing.assert_array_equal(frame.image, IMAGE)
    counts = camera.counts()
    assert counts.packets_lost > 3  # of 200
    assert counts.lost == frames[-1].number - 40
    assert counts.lost < 10  # without a second chance it would be two frames in five


def test_without_any_packet_there_is_no_frame(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect)
    received(camera, 1)
    served.fault("packet_loss")
    while camera.next_frame(0.2) is not None:
        pass
    assert camera.next_frame(0.2) is None  # and control is kept: no error


def test_packets_too_large_for_the_network_are_named_when_the_camera_is_opened(
    serve: Serve, connect: Connect
) -> None:
    served = serve()
    served.fault("mtu", value=1000.0)
    with pytest.raises(DeviceMismatch, match=r"packets of 1500 bytes.*got packets of 576 bytes"):
        connect(served, **FAST)
    connect(served, **FAST, packet_size_bytes=1000)  # and control was given up


def test_packets_that_become_too_large_are_lost_and_counted(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect)
    received(camera, 1)
    served.fault("mtu")
    while camera.next_frame(0.2) is not None:
        pass
    assert camera.counts().packets_lost > 0


def test_a_camera_that_sends_no_test_packet_is_taken_as_it_is(
    serve: Serve, connect: Connect
) -> None:
    served = serve()
    served.fault("packet_loss")
    camera = connect(served, **FAST)
    served.mend()
    camera.start()
    np.testing.assert_array_equal(received(camera, 1)[0].image, IMAGE)


def test_frames_that_are_never_sent_are_counted_and_leave_gaps(
    serve: Serve, connect: Connect
) -> None:
    served, camera = running(serve, connect)
    served.fault("frame_drop", probability=0.3)
    frames = received(camera, 50)
    steps = [b.number - a.number for a, b in pairwise(frames)]
    assert max(steps) > 1
    assert camera.counts().lost >= sum(steps) - 49


@pytest.mark.parametrize("kind", ["duplicate", "reorder"])
def test_packets_twice_or_out_of_order_make_the_same_frames(
    serve: Serve, connect: Connect, kind: str
) -> None:
    served, camera = running(serve, connect)
    served.fault(kind)
    frames = received(camera, 30)
    for frame in frames:
        np.testing.assert_array_equal(frame.image, IMAGE)
    assert all(b.number > a.number for a, b in pairwise(frames))


def test_late_frames_are_late_and_say_so(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect)
    served.fault("delay", value=0.05)
    served_s = time.monotonic()
    while (frame := received(camera, 1)[0]).mid_exposure_s < served_s:
        pass
    assert frame.received_s - frame.mid_exposure_s >= 0.034 + 0.05


def test_what_is_wrong_with_the_picture_comes_as_it_is(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    across, down = (int(part * 40) for part in HOT_PIXEL)
    expected = {
        "background_jump": STAR + 300.0,
        "hot_pixel": STAR + 300.0 * (np.indices((40, 40)) == [[[down]], [[across]]]).all(axis=0),
        "saturation": np.minimum(STAR, 300.0),
    }
    for kind, image in expected.items():
        served.fault(kind, value=300.0)
        np.testing.assert_array_equal(image_after(camera, time.monotonic()), image)
        served.mend()
    np.testing.assert_array_equal(image_after(camera, time.monotonic()), STAR)


def test_a_fading_star_goes_and_the_noise_stays(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault("star_fading", value=0.05)
    begun_s = time.monotonic()
    later = image_after(camera, begun_s + 0.1)
    assert 500 < later[20, 24] - 1000 < 2300  # a quarter or less of 8000, and noise
    gone = image_after(camera, begun_s + 0.6)
    assert abs(gone[20, 24] - 1000) < 150
    assert 15 < gone.std() < 25  # the rig's 20 DN
    served.mend()
    np.testing.assert_array_equal(image_after(camera, time.monotonic()), STAR)


def test_a_dim_star_has_part_of_its_light(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault("star_dim", value=0.5)
    dim = image_after(camera, time.monotonic())
    assert abs(dim[20, 24] - 5000) < 150
    assert 12 < dim[:10].std() < 23  # what is left of an image without noise


def test_a_dark_half_has_noise_and_no_light(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault("dark_half", part="right")
    image = image_after(camera, time.monotonic())
    np.testing.assert_array_equal(image[:, :20], STAR[:, :20])
    assert abs(image[:, 20:].mean() - 1000) < 20
    assert abs(int(image[:, 20:].max()) - 1000) < 150


def test_a_star_that_jumps_is_elsewhere_on_a_dark_picture(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault("star_jump", value=5.0)
    jumped = image_after(camera, time.monotonic())
    np.testing.assert_array_equal(jumped[5:, 5:], STAR[:-5, :-5])
    assert abs(jumped[:5].mean() - 1000) < 20
    assert 15 < jumped[:5].std() < 25  # the rig's 20 DN


def test_a_doubled_star_is_there_twice(serve: Serve, connect: Connect) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault("star_double", value=8.0)
    doubled = image_after(camera, time.monotonic())
    for across in (24, 32):
        assert abs(doubled[20, across] - 9000) < 150


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("star_fading", 0.0),
        ("star_dim", -1.0),
        ("star_jump", 1e9),
        ("star_double", -1e9),
        ("saturation", -5.0),
        ("background_jump", 1e9),
        ("hot_pixel", -1e9),
    ],
)
def test_values_beyond_sense_harm_nobody(
    serve: Serve, connect: Connect, kind: str, value: float
) -> None:
    served, camera = running(serve, connect, STAR)
    served.fault(kind, value=value)
    image = image_after(camera, time.monotonic())
    assert image.min() >= 0
    assert image.max() <= 65535


def test_every_fault_is_tried_in_this_file() -> None:
    with open(__file__, encoding="utf-8") as file:
        text = file.read()
    assert [kind for kind in FAULTS if f'"{kind}"' not in text] == []
