"""npm @mcap/core, which Foxglove and Lichtblick read with, on our logs."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from samples.log_samples import RUN_INFO, SETTINGS, frame, one_of_each, tick, write_log

from fitctl.logging.copying import cut, merge, recover
from fitctl.logging.reading import log_info

CHECKER = Path(__file__).parent / "mcap"
RECORDS = [RUN_INFO, *one_of_each(), *(r for n in range(2, 40) for r in (tick(n), frame(n)))]

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed"),
    pytest.mark.skipif(
        not (CHECKER / "node_modules" / "@mcap" / "core").exists(),
        reason="npm @mcap/core is not installed: `npm --prefix tests/peers/mcap ci`",
    ),
]


def checked(path):
    result = subprocess.run(
        ["node", "check.mjs", path], cwd=CHECKER, check=False, capture_output=True, timeout=60
    )
    assert result.returncode == 0, result.stderr.decode()
    return json.loads(result.stdout)


def mended(path):
    path.write_bytes(path.read_bytes()[:-3000])
    recover(path, path, overwrite=True)


def halved_and_merged(path):
    head, tail = path.with_name("head.mcap"), path.with_name("tail.mcap")
    middle_ns = round((log_info(path).start_s + 20) * 1e9)
    cut(path, head, from_ns=0, to_ns=middle_ns)
    cut(path, tail, from_ns=middle_ns, to_ns=2**63)
    merge([head, tail], path, overwrite=True)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize(
    "change",
    [lambda path: None, mended, halved_and_merged],
    ids=["recorded", "recovered", "merged"],
)
def test_every_message_is_read_with_all_checksums_and_by_the_index(tmp_path, compression, change):
    settings = SETTINGS.model_copy(update={"compression": compression, "chunk_bytes": 4096})
    path = write_log(tmp_path / "a.mcap", RECORDS, settings)
    change(path)
    found = checked(path)
    assert found["done"]
    assert found["streamed"] == found["indexed"] == log_info(path).counts
    assert found["metadata"] == log_info(path).metadata
    assert found["first"]["/fit/right/tick"]["mode"] == "VERNIER"
    assert found["first"]["/fit/right/tick"]["error_az_px"] == 0.125
    assert found["first"]["/fit/camera/frame"]["encoding"] == "mono16"


def test_a_damaged_log_is_refused_so_the_checksums_count(tmp_path):
    path = write_log(tmp_path / "a.mcap", RECORDS)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(AssertionError, match=r"(?i)crc|decompress|zstd"):
        checked(path)
