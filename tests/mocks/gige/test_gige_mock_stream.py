"""The mock camera's stream: what leaves it, and when."""

from __future__ import annotations

import asyncio
import time

import numpy as np
import pytest
from gige_asked import (
    ME,
    ask,
    read,
    received,
    resend,
    scenario,
    streaming,
    write,
    write_double,
)
from numpy.typing import NDArray

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige import protocol as p
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.gige.memory import TICKS_PER_S, Feature


def test_a_test_packet_has_the_size_that_was_asked_for() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, p.Register.STREAM_PACKET_SIZE, p.PACKET_SIZE_FIRE_TEST | 1400)
            assert len(await received(client)) == 1400 - 28
        assert read(mock, p.Register.STREAM_PACKET_SIZE) == 1400

    scenario(check)


def test_a_frame_that_is_gone_is_answered_as_unavailable() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.ACQUISITION_START, 1)
            resend(mock, p.Resend(0, 9999, 1, 2))
            header = p.decode_stream_header(await received(client))
        assert header == p.StreamHeader(p.Status.PACKET_UNAVAILABLE, 9999, p.FORMAT_PAYLOAD, 1)

    scenario(check)


def test_packets_are_sent_again_as_often_as_they_are_asked_for() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.ACQUISITION_MODE, 1)
            write(mock, Feature.ACQUISITION_START, 1)
            packets = [await received(client) for _ in range(8)]  # leader, 6 x 540 bytes, trailer
            for _ in range(2):
                resend(mock, p.Resend(0, 1, 2, 3))
                for packet_id in (2, 3):
                    again = await received(client)
                    status = p.decode_stream_header(again).status
                    assert status == p.Status.PACKET_RESEND
                    assert again[2:] == packets[packet_id][2:]

    scenario(check)


def test_a_camera_that_resends_nothing_says_so_and_does_not() -> None:
    async def check(mock: GigeCameraMock) -> None:
        capability = read(mock, p.Register.GVCP_CAPABILITY)
        assert not capability & p.CAPABILITY_PACKETRESEND
        async with streaming(mock) as client:
            write(mock, Feature.ACQUISITION_MODE, 1)
            write(mock, Feature.ACQUISITION_START, 1)
            for _ in range(8):
                await received(client)
            payload = p.encode_resend(p.Resend(0, 1, 2, 3))
            answer = ask(mock, p.Command.PACKETRESEND, payload)
            assert answer.status == p.Status.NOT_IMPLEMENTED
            with pytest.raises(TimeoutError):
                await received(client, within_s=0.05)

    scenario(check, resends=False)


@pytest.mark.parametrize(
    ("name", "pixel"), [("Mono8", "12"), ("Mono12", "2301"), ("Mono16", "3012")]
)
def test_pixels_are_little_endian_and_start_at_the_least_bit(name: str, pixel: str) -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.WIDTH, 8)
            write(mock, Feature.HEIGHT, 8)
            write(mock, Feature.PIXEL_FORMAT, p.PIXEL_FORMATS[name].code)
            payload_bytes = 64 * p.PIXEL_FORMATS[name].bytes
            assert read(mock, Feature.PAYLOAD_SIZE) == payload_bytes
            write(mock, Feature.ACQUISITION_START, 1)
            leader = p.decode_leader((await received(client))[8:])
            assert (leader.pixel_format, leader.width_px) == (p.PIXEL_FORMATS[name].code, 8)
            assert (await received(client))[8:] == 64 * bytes.fromhex(pixel)

    scenario(check)


def test_the_window_on_the_sensor_can_be_moved() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.WIDTH, 8)
            assert write(mock, Feature.OFFSET_X, 33) == p.Status.INVALID_PARAMETER
            assert write(mock, Feature.OFFSET_X, 32) == p.Status.SUCCESS
            write(mock, Feature.ACQUISITION_START, 1)
            leader = p.decode_leader((await received(client))[8:])
            assert (leader.offset_x_px, leader.width_px, leader.height_px) == (32, 8, 40)

    scenario(check)


def test_between_two_packets_is_the_delay_that_was_asked_for() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, p.Register.STREAM_PACKET_DELAY, round(0.004 * TICKS_PER_S))
            write(mock, Feature.ACQUISITION_MODE, 1)
            write(mock, Feature.ACQUISITION_START, 1)
            await received(client)
            first_s = time.monotonic()
            for _ in range(7):
                await received(client)
            assert time.monotonic() - first_s > 6 * 0.004  # the first may have been taken late

    scenario(check)


def test_frames_that_a_delay_leaves_no_time_for_are_left_out() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock):
            write(mock, p.Register.STREAM_PACKET_DELAY, TICKS_PER_S)
            write_double(mock, Feature.EXPOSURE_TIME_US, 500.0)
            write_double(mock, Feature.FRAME_RATE_HZ, 2000.0)
            write(mock, Feature.ACQUISITION_START, 1)
            while not mock._parts()[0].frames_left_out:  # the test's time limit ends it
                await asyncio.sleep(0.01)

    scenario(check)


def test_a_picture_that_motion_smears_is_asked_for_when_its_exposure_has_ended() -> None:
    asked: list[float] = []

    def picture(middle_s: float) -> NDArray[np.uint16]:
        asked.append(time.monotonic() - middle_s)
        return np.zeros((40, 40), np.uint16)

    async def check() -> None:
        rig = load_rig(default_rig_path())
        _, mocks = rig.mock_parts()
        mock = GigeCameraMock(rig.camera, mocks.camera, picture, port=0, smears=True)
        await mock.start()
        try:
            async with streaming(mock) as client:
                write_double(mock, Feature.FRAME_RATE_HZ, 10.0)
                write_double(mock, Feature.EXPOSURE_TIME_US, 80_000.0)
                write(mock, Feature.ACQUISITION_START, 1)
                await received(client)
        finally:
            await mock.stop()

    asyncio.run(check())

    assert asked[0] > 0.04 - 0.002  # an event loop may wake a little early


def test_with_the_trigger_on_each_trigger_is_one_frame() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.TRIGGER_MODE, 1)
            write(mock, Feature.ACQUISITION_START, 1)
            with pytest.raises(TimeoutError):
                await received(client, within_s=0.1)
            for block_id in (1, 2):
                write(mock, Feature.TRIGGER_SOFTWARE, 1)
                write(mock, Feature.TRIGGER_SOFTWARE, 1)  # busy: without effect
                packets = [await received(client) for _ in range(8)]
                assert {p.decode_stream_header(one).block_id for one in packets} == {block_id}
                with pytest.raises(TimeoutError):
                    await received(client, within_s=0.1)

    scenario(check)


def test_a_command_that_comes_again_is_answered_again_and_done_once() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write_double(mock, Feature.FRAME_RATE_HZ, 100.0)
            write(mock, Feature.TRIGGER_MODE, 1)
            write(mock, Feature.ACQUISITION_START, 1)
            words = p.encode_words(Feature.TRIGGER_SOFTWARE, 1)
            trigger = p.encode_command(p.Command.WRITEREG, 77, words)
            answers = []
            for _ in range(3):
                answers.append(mock.answer(trigger, ME))
                await asyncio.sleep(0.02)  # the camera is ready for another
            assert len(set(answers)) == 1
            for _ in range(8):
                await received(client)
            with pytest.raises(TimeoutError):
                await received(client, within_s=0.1)

    scenario(check)


def test_a_mock_that_was_held_up_sends_every_frame_late_and_says_so() -> None:
    async def check(mock: GigeCameraMock) -> None:
        async with streaming(mock) as client:
            write(mock, Feature.ACQUISITION_START, 1)
            time.sleep(0.3)  # the event loop stands still
            blocks = set()
            while len(blocks) < 7:
                blocks.add(p.decode_stream_header(await received(client)).block_id)
        assert blocks == {1, 2, 3, 4, 5, 6, 7}
        assert mock.acquisition.late_frames >= 6
        assert mock.acquisition.worst_late_s > 0.2

    scenario(check)
