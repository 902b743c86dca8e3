"""A few kilobytes cannot take gigabytes of memory."""

import base64
import tracemalloc
import zlib
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from fitctl.config import ConfigError
from fitctl.controllers.dark import dark_bytes
from fitctl.logging.copying import recover
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.schemas import dark_npy_of
from fitctl.logging.seeking import SeekableLog
from fitctl.logging.verifying import verify

BOMB_BYTES = 300 << 20


def bomb(path, compression, *, finished):
    """A small log with a chunk that unpacks to 300 MiB."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=1 << 30)
        writer.start()
        schema = writer.register_schema("x", "protobuf", b"")
        channel = writer.register_channel("/x", "protobuf", schema)
        writer.add_message(channel, 1, bytes(BOMB_BYTES), 1)
        writer.finish()
    if not finished:
        path.write_bytes(path.read_bytes()[:-8])
    return path


@pytest.mark.long
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("finished", [True, False])
def test_a_chunk_that_unpacks_to_too_much_is_damage(compression, finished, tmp_path):
    path = bomb(tmp_path / "bomb.mcap", compression, finished=finished)
    tracemalloc.start()
    try:
        if finished:
            with pytest.raises(LogError, match="unpacks to more than 64 MiB"):
                list(read_records(path))
        else:
            assert log_info(path).counts == {}
        with pytest.raises(LogError, match="nothing to recover"):
            recover(path, tmp_path / "recovered.mcap")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert peak < BOMB_BYTES


@pytest.mark.parametrize(("read", "finished"), [(log_info, False), (verify, True)])
def test_channels_that_unpack_to_too_much_are_refused(read, finished, tmp_path):
    path = tmp_path / "channels.mcap"
    with path.open("wb") as stream:
        writer = Writer(
            stream, compression=CompressionType.ZSTD, chunk_size=1 << 30, repeat_channels=False
        )
        writer.start()
        schema = writer.register_schema("x", "protobuf", b"")
        for number in range(20):
            channel = writer.register_channel(f"/{number}{'x' * (1 << 20)}", "protobuf", schema)
        writer.add_message(channel, 1, b"", 1)
        writer.finish()
    if not finished:
        path.write_bytes(path.read_bytes()[:-8])  # as of a recorder that was killed

    with pytest.raises(LogError, match="schemas or channels of more than 16 MiB"):
        read(path)


@pytest.mark.parametrize("read", [lambda path: list(read_records(path)), SeekableLog])
def test_schemas_that_unpack_to_too_much_are_refused(read, tmp_path):
    path = tmp_path / "schemas.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=1 << 30)
        writer.start()
        for number in range(20):
            schema = writer.register_schema(f"{number}", "protobuf", bytes(1 << 20))
        writer.add_message(writer.register_channel("/x", "protobuf", schema), 1, b"", 1)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-8])  # as of a recorder that was killed

    with pytest.raises(LogError, match="schemas or channels of more than 16 MiB"):
        read(path)


@pytest.mark.long
def test_a_dark_frame_in_a_log_is_bounded_too():
    text = base64.b64encode(zlib.compress(bytes(BOMB_BYTES))).decode()
    with pytest.raises(ValueError, match="more than 64 MiB"):
        dark_npy_of({"dark": {"npy_zlib_base64": text}})


def test_a_dark_frame_s_file_is_a_regular_one_below_a_size(tmp_path):
    with pytest.raises(ConfigError, match="not a regular file"):
        dark_bytes(Path("/dev/zero"))
    large = tmp_path / "large.npy"
    with large.open("wb") as file:
        file.truncate(BOMB_BYTES)
    with pytest.raises(ConfigError, match="more than 64 MiB"):
        dark_bytes(large)


def test_a_device_is_no_log():
    with pytest.raises(LogError, match="not a regular file"):
        log_info(Path("/dev/zero"))
