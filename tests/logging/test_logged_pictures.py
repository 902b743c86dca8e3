"""A log's frames as the mock camera asks for them."""

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from samples.forged_logs import with_messages_of_another_program
from samples.log_samples import RUN_INFO, frame, tick, write_log

from fitctl.logging.errors import LogError
from fitctl.logging.pictures import LoggedPictures

PERIOD_S = 0.02
SIZE = (40, 40)


def at(number):
    """A frame whose exposure is so many periods after the first."""
    return frame(number, time_s=100.0 + PERIOD_S * number)


@pytest.fixture
def pictures(tmp_path):
    said = []

    def make(*records, size=SIZE):
        log = write_log(tmp_path / "log.mcap", [RUN_INFO, *records])
        return LoggedPictures(log, *size, PERIOD_S, 1000.0, said.append)

    make.said = said
    return make


def image(number):
    return np.frombuffer(at(number).data, "<u2").reshape(SIZE)


def test_each_exposure_shows_its_frame_from_whenever_the_camera_was_started(pictures):
    picture = pictures(*map(at, range(5, 10)))

    for count in range(5):
        # A camera's clock is not the log's: less than half a period off is still the same frame.
        shown = picture(7.0 + count * PERIOD_S * 1.05)
        assert np.array_equal(shown, image(5 + count))


def test_in_a_gap_the_last_frame_stays_and_after_the_end_it_is_dark_and_told_once(pictures):
    picture = pictures(at(0), at(1), at(4))

    shown = [picture(count * PERIOD_S) for count in range(9)]

    for count, number in enumerate([0, 1, 1, 1, 4]):
        assert np.array_equal(shown[count], image(number))
    assert all(np.all(dark == 1000) for dark in shown[6:])
    (why,) = pictures.said
    assert why.endswith("its frames are over")


def test_a_frame_with_too_little_data_ends_the_pictures(pictures):
    short = msgspec.structs.replace(at(1), data=at(1).data[:-2])
    picture = pictures(at(0), short, at(2))
    for count in range(4):
        picture(count * PERIOD_S)

    (why,) = pictures.said
    assert "has a frame of 3198 bytes" in why


def test_a_log_without_frames_is_refused(pictures):
    with pytest.raises(LogError, match=r"log.mcap: has no frames"):
        pictures(tick(1))


def test_frames_of_another_size_are_refused_with_both_sizes(pictures):
    with pytest.raises(LogError, match=r"40 x 40 px where the rig's camera has 41 x 40"):
        pictures(at(0), size=(41, 40))


def test_frames_that_are_no_pictures_are_refused(tmp_path):
    path = with_messages_of_another_program(tmp_path / "b.mcap", "/fit/camera/frame", Log())

    with pytest.raises(LogError, match=r"b\.mcap: /fit/camera/frame has messages of type foxglove"):
        LoggedPictures(path, *SIZE, PERIOD_S, 1000.0, print)
