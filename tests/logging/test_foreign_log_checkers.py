"""Programs that are not ours accept our logs: pymcap-cli (Python) and rerun (Rust)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from samples.log_samples import RUN_INFO, SETTINGS, one_of_each, tick

from fitctl.logging.copying import cut, merge, recover
from fitctl.logging.reading import log_info
from fitctl.logging.writer import LogWriter

BIN = Path(sys.executable).parent
CONTENTS = {
    "full": [RUN_INFO, *one_of_each(), *(tick(n) for n in range(2, 200))],
    "no run info": [tick(1, time_s=1.0)],
    "empty": [],
}


@pytest.fixture
def run(tmp_path):
    """Run a tool away from the user's home: rerun's usage reports stay off."""
    environment = os.environ | {
        name: str(tmp_path / "home") for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME")
    }

    def run(tool, *arguments):
        command = [BIN / tool, *arguments]
        result = subprocess.run(
            command, env=environment, check=False, capture_output=True, text=True, timeout=60
        )
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    run("rerun", "analytics", "disable")
    return run


def written(tmp_path, content, compression="zstd"):
    settings = SETTINGS.model_copy(update={"compression": compression, "chunk_bytes": 4096})
    with LogWriter(tmp_path / "log.mcap", settings) as writer:
        for number, record in enumerate(CONTENTS[content]):
            writer.write(record, 4e9 + 0.02 * number)
    return writer.path


def pymcap_finds_nothing_wrong(run, path):
    printed = run("pymcap-cli", "doctor", "--format", "jsonl", path)
    summary = json.loads(printed.splitlines()[-1])
    assert (summary["errors"], summary["warnings"], summary["complete"]) == (0, 0, True), printed


def rerun_finds_every_topic_in_order(run, path):
    printed = run("rerun", "mcap", "check", "--full", path)
    rows = [line.split() for line in printed.splitlines() if " /fit/" in line]
    assert len(rows) == len(one_of_each())
    assert {row[0] for row in rows} == {"ok"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("content", "compression"),
    [("full", "zstd"), ("full", "lz4"), ("no run info", "none"), ("empty", "zstd")],
)
def test_pymcap_doctor_finds_nothing_wrong(tmp_path, run, content, compression):
    pymcap_finds_nothing_wrong(run, written(tmp_path, content, compression))


def recovered(path, target):
    path.write_bytes(path.read_bytes()[:-3000])
    recover(path, target)


def halved_and_merged(path, target):
    middle_ns = round((log_info(path).start_s + 2.0) * 1e9)
    halves = [path.with_name(f"{half}.mcap") for half in ("head", "tail")]
    cut(path, halves[0], from_ns=0, to_ns=middle_ns)
    cut(path, halves[1], from_ns=middle_ns, to_ns=2**63)
    merge(halves, target)


@pytest.mark.long
@pytest.mark.parametrize("change", [recovered, halved_and_merged])
def test_both_accept_what_is_made_from_a_log(tmp_path, run, change):
    target = tmp_path / "changed.mcap"
    change(written(tmp_path, "full"), target)
    pymcap_finds_nothing_wrong(run, target)
    rerun_finds_every_topic_in_order(run, target)


def test_rerun_check_finds_every_topic_in_order(tmp_path, run):
    rerun_finds_every_topic_in_order(run, written(tmp_path, "full"))


def test_rerun_converts_every_topic_with_its_types(tmp_path, run):
    converted = tmp_path / "log.rrd"
    run("rerun", "mcap", "convert", written(tmp_path, "full"), "-o", converted)
    printed = run("rerun", "rrd", "print", "-vvv", converted)
    for content in (
        '"star_az_px": non-null Float64',
        '"mode": non-null Utf8',
        '"mode_number": non-null Int64',
        '"fsm_saturated": non-null Boolean',
        "Image:buffer",
        "TextLog:text",
    ):
        assert content in printed
