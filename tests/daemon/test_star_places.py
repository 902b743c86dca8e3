"""The file from which a supervisor knows where the stars were when the one before it was killed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.daemon.star_places import FILE, StarPlaces
from fitctl.logging.records import StarPlace

PLACE = StarPlace(
    time_s=5.0,
    loop="right",
    az_px=-120.5,
    el_px=33.25,
    siderostat_az_rad=1.5,
    siderostat_el_rad=-2.5,
    link_az_rad=0.25,
    link_el_rad=-12.0,
)


def written(folder, places):
    """Have the file written whole by one that is then killed."""
    writer = StarPlaces(folder)
    writer.write(places)
    while writer.read() != places:
        pass
    return writer


def test_what_a_killed_supervisor_left_is_read(tmp_path):
    written(tmp_path, [PLACE])

    assert StarPlaces(tmp_path).read() == [PLACE]


def test_one_that_ends_as_told_leaves_nothing(tmp_path):
    with written(tmp_path, [PLACE]):
        pass

    assert list(tmp_path.iterdir()) == []
    assert StarPlaces(tmp_path).read() == []


def test_a_folder_that_has_vanished_is_no_error(tmp_path):
    folder = tmp_path / "sockets"
    folder.mkdir()
    with written(folder, [PLACE]) as writer:
        (folder / FILE).unlink()
        folder.rmdir()
        writer.write([PLACE])

    assert writer.read() == []


@pytest.mark.parametrize("left", [b"", b"[1]", b'[{"loop":"\xff"}]', 2000 * b"["])
def test_a_damaged_file_is_none(tmp_path, left):
    (tmp_path / FILE).write_bytes(left)

    assert StarPlaces(tmp_path).read() == []


def test_one_that_ends_by_an_error_leaves_what_it_knew(tmp_path):
    with pytest.raises(RuntimeError), written(tmp_path, [PLACE]):
        raise RuntimeError

    assert StarPlaces(tmp_path).read() == [PLACE]


@given(st.binary(max_size=200))
def test_any_other_content_is_nothing(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("sockets")
    (folder / FILE).write_bytes(content)

    assert isinstance(StarPlaces(folder).read(), list)


@pytest.mark.parametrize(
    "content", [b"", b"[", b"[1]", b"{}", b'[{"time_s": 1}]', b"[null]", b"0" * 70_000]
)
def test_damaged_content_is_nothing(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)

    assert StarPlaces(tmp_path).read() == []
