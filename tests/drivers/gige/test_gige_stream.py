from __future__ import annotations

import contextlib
import dataclasses
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.stream import ASK_AGAIN_S, CompleteFrame, FrameAssembler
from fitctl.drivers.interface import DeviceMismatch, DeviceProtocolError
from fitctl.mocks.gige.stream import StreamSettings, frame_packets

MONO16 = protocol.PIXEL_FORMATS["Mono16"]
SETTINGS = StreamSettings(("127.0.0.1", 1), 576, 0.0, MONO16, 40, 30, 0, 0)
IMAGE = np.arange(1200, dtype=np.uint16).reshape(30, 40)


class Receiver:
    """An assembler with the resend requests that it makes."""

    def __init__(self) -> None:
        self.asked: list[protocol.Resend] = []
        self.assembler = FrameAssembler(
            40, 30, MONO16, 576, Endpoint("camera", "test"), self.asked.append
        )

    def take(self, *packets: bytes) -> list[CompleteFrame]:
        frames = [self.assembler.add(memoryview(packet)) for packet in packets]
        return [frame for frame in frames if frame is not None]


def packets_of(block_id: int) -> list[bytes]:
    return frame_packets(block_id, 1000 * block_id, IMAGE.tobytes(), SETTINGS)


@given(seed=st.integers(0, 1000))
def test_packets_may_come_in_any_order(seed: int) -> None:
    packets = packets_of(1)
    random.Random(seed).shuffle(packets)
    (frame,) = Receiver().take(*packets)
    assert frame.leader.timestamp_ticks == 1000
    np.testing.assert_array_equal(frame.image, IMAGE)


def test_the_trailer_shows_a_hole_which_is_asked_for_and_healed() -> None:
    receiver = Receiver()
    packets = packets_of(1)
    assert receiver.take(*packets[:2], *packets[4:], packets[6]) == []
    assert receiver.asked == [protocol.Resend(0, 1, 2, 3)]
    (frame,) = receiver.take(packets[2], packets[3])
    np.testing.assert_array_equal(frame.image, IMAGE)
    assert (receiver.assembler.lost, receiver.assembler.packets_lost) == (0, 2)


def test_what_is_lost_again_is_asked_for_again_five_times_at_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("fitctl.drivers.gige.stream.time.monotonic", lambda: now_s[0])
    receiver = Receiver()
    packets = packets_of(1)
    receiver.take(*packets[:5], packets[6])
    for asked in (1, 2, 3, 4, 5, 5):
        receiver.assembler.ask_again()
        receiver.assembler.ask_again()  # not before its time
        assert len(receiver.asked) == asked
        now_s[0] += ASK_AGAIN_S
    assert receiver.asked == 5 * [protocol.Resend(0, 1, 5, 5)]
    assert receiver.assembler.ask_again() is None
    assert len(receiver.take(packets[5])) == 1
    assert receiver.assembler.packets_lost == 1


def test_nothing_is_asked_for_again_once_it_has_come() -> None:
    receiver = Receiver()
    packets = packets_of(1)
    receiver.take(*packets[:5], packets[6], packets[5])
    assert receiver.assembler.ask_again() is None


def test_each_run_of_missing_packets_is_asked_for_by_itself() -> None:
    receiver = Receiver()
    packets = packets_of(1)
    receiver.take(packets[0], packets[2], packets[3], packets[5], packets[6])
    assert receiver.asked == [protocol.Resend(0, 1, 1, 1), protocol.Resend(0, 1, 4, 4)]


def test_a_lost_end_of_a_frame_shows_at_the_next_frame() -> None:
    receiver = Receiver()
    receiver.take(*packets_of(1)[:5], packets_of(2)[0])
    assert receiver.asked == [protocol.Resend(0, 1, 5, 5)]


def test_a_frame_that_stays_incomplete_is_lost_when_a_later_one_is_complete() -> None:
    receiver = Receiver()
    (frame,) = receiver.take(*packets_of(1)[:4], *packets_of(2))
    assert frame.number == 2
    assert (receiver.assembler.frames, receiver.assembler.lost) == (1, 1)


def test_a_frame_that_was_given_up_costs_no_later_one_when_the_rest_of_it_comes() -> None:
    receiver = Receiver()
    packets = {block_id: packets_of(block_id) for block_id in range(1, 6)}
    for block_id in packets:  # all but their last pixels; the fifth frame is one too many
        receiver.take(*packets[block_id][:5])
    lost = receiver.assembler.packets_lost

    assert receiver.take(packets[1][5]) == []
    frames = receiver.take(*[packets[block_id][5] for block_id in (2, 3, 4, 5)])

    assert [frame.number for frame in frames] == [2, 3, 4, 5]
    assert (receiver.assembler.lost, receiver.assembler.packets_lost) == (1, lost)


def test_of_too_many_frames_at_once_the_oldest_is_given_up_though_it_came_last() -> None:
    receiver = Receiver()
    packets = {block_id: packets_of(block_id) for block_id in range(1, 7)}
    receiver.take(*packets[1])
    for block_id in (3, 4, 5, 6, 2):
        receiver.take(*packets[block_id][:5])

    frames = receiver.take(*[packets[block_id][5] for block_id in (2, 3, 4, 5, 6)])

    assert [frame.number for frame in frames] == [3, 4, 5, 6]


def test_the_number_counts_exposures_across_the_wrap_of_block_ids() -> None:
    receiver = Receiver()
    frames = receiver.take(*packets_of(65534), *packets_of(65535), *packets_of(2))
    first = frames[0].number
    assert [frame.number - first for frame in frames] == [0, 1, 3]
    assert receiver.assembler.lost == 1


def test_packets_of_frames_that_are_over_change_nothing() -> None:
    receiver = Receiver()
    receiver.take(*packets_of(5))
    assert receiver.take(*packets_of(5), *packets_of(4)) == []
    assert receiver.assembler.frames == 1


@given(noise=st.binary(max_size=100).filter(lambda b: len(b) < 5 or not b[4] & 0x80))
def test_noise_makes_no_frame(noise: bytes) -> None:
    receiver = Receiver()
    with contextlib.suppress(DeviceProtocolError, DeviceMismatch):  # a leader of no image of ours
        assert receiver.take(noise) == []


def test_another_image_size_is_a_mismatch() -> None:
    other = frame_packets(1, 0, bytes(2 * 30 * 39), dataclasses.replace(SETTINGS, width_px=39))
    with pytest.raises(DeviceMismatch, match=r"40 x 30 px.* 39 x 30 px"):
        Receiver().take(other[0])


def test_extended_block_ids_are_refused_by_name() -> None:
    header = protocol.encode_stream_header(protocol.StreamHeader(0, 0, 0x81, 0))
    with pytest.raises(DeviceProtocolError, match="16-bit block ids"):
        Receiver().take(header + bytes(48))
