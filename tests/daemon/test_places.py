"""The file from which a supervisor knows where stars and beams were when the one before it was killed."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.daemon.places import FILE, Places
from fitctl.logging.records import BeamPlace, StarPlace

PLACE = StarPlace(
    time_s=5.0,
    loop="right",
    az_px=-120.5,
    el_px=33.25,
    siderostat_az_rad=1.5,
    siderostat_el_rad=-2.5,
    link_az_rad=0.25,
    link_el_rad=-12.0,
    moved_az_rad=0.0,
    moved_el_rad=0.0,
)
BEAM = BeamPlace(
    time_s=5.0,
    loop="metrology",
    search_az_rad=3.0,
    search_el_rad=-0.5,
    siderostat_az_rad=12.0,
    siderostat_el_rad=7.0,
)


def written(folder, places):
    """Have the file written whole by one that is then killed."""
    writer = Places(folder)
    writer.write(places)
    while writer.read() != places:
        pass
    return writer


def test_what_a_killed_supervisor_left_is_read(tmp_path):
    written(tmp_path, [PLACE, BEAM])

    assert Places(tmp_path).read() == [PLACE, BEAM]


def test_one_that_ends_as_told_leaves_nothing(tmp_path):
    with written(tmp_path, [PLACE, BEAM]):
        pass

    assert list(tmp_path.iterdir()) == []
    assert Places(tmp_path).read() == []


def test_a_folder_that_has_vanished_is_no_error(tmp_path):
    folder = tmp_path / "sockets"
    folder.mkdir()
    with written(folder, [PLACE, BEAM]) as writer:
        (folder / FILE).unlink()
        folder.rmdir()
        writer.write([PLACE, BEAM])

    assert writer.read() == []


@pytest.mark.parametrize("left", [b"", b"[1]", b'[{"loop":"\xff"}]', 2000 * b"["])
def test_a_damaged_file_is_none(tmp_path, left):
    (tmp_path / FILE).write_bytes(left)

    assert Places(tmp_path).read() == []


def test_one_that_ends_by_an_error_leaves_what_it_knew(tmp_path):
    with pytest.raises(RuntimeError), written(tmp_path, [PLACE, BEAM]):
        raise RuntimeError

    assert Places(tmp_path).read() == [PLACE, BEAM]


@pytest.mark.parametrize("field", ["time_s", "az_px", "rate_az_sky_arcsec_s"])
def test_a_place_that_is_nowhere_is_left_out(tmp_path, field):
    nowhere = msgspec.structs.replace(PLACE, **{field: 1e16})
    (tmp_path / FILE).write_bytes(msgspec.json.encode([nowhere, BEAM]))

    assert Places(tmp_path).read() == [BEAM]


@given(st.binary(max_size=200))
def test_any_other_content_is_nothing(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("sockets")
    (folder / FILE).write_bytes(content)

    assert isinstance(Places(folder).read(), list)


@pytest.mark.parametrize(
    "content", [b"", b"[", b"[1]", b"{}", b'[{"time_s": 1}]', b"[null]", b"0" * 70_000]
)
def test_damaged_content_is_nothing(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)

    assert Places(tmp_path).read() == []
