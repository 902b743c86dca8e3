"""What a supervisor holds of the machine's memory while it points."""

import json
import sys
import time
from pathlib import Path

import pytest

from fitctl.messages.commands import SetController

from .conftest import NEAR, end, running

MOST_BYTES = 200_000_000
NOT_FOR_THE_LOOP = {"control", "matplotlib", "numba", "rich", "scipy", "textual"}
# Stands before the supervisor's own command line, and writes what was imported when it has ended.
WITNESS = """
import atexit, json, runpy, sys
file, _python, _dash_m, module = sys.argv[1:5]
sys.argv = [module, *sys.argv[5:]]
atexit.register(lambda: json.dump(sorted(sys.modules), open(file, "w")))
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.fixture
def witnessed(tmp_path):
    """The instrument in VERNIER, and the file with what its supervisor has imported once that has ended."""
    modules = tmp_path / "modules.json"
    before = (sys.executable, "-c", WITNESS, modules)
    with running(tmp_path, NEAR, before=before) as rig:
        rig.to_vernier()
        yield rig, modules


def status_bytes(pid):
    """Sizes of a process by their names in proc(5)."""
    rows = (line.split() for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {row[0].rstrip(":"): int(row[1]) * 1024 for row in rows if row[-1] == "kB"}


def page_faults(pid):
    """Minor and major page faults of a process's main thread, which ticks."""
    fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[7]), int(fields[9])


def scheduling(rig):
    return rig.follow(lambda _: True)[-1].scheduling


def test_a_supervisor_is_small_and_stays_so_through_a_new_design(witnessed):
    rig, modules = witnessed
    pid = rig.supervisor.pid
    assert rig.client.send(SetController(name="fslq")).accepted
    rig.follow(lambda telemetry: telemetry.loops[0].controller == "fslq")
    size = status_bytes(pid)
    assert size["VmRSS"] < MOST_BYTES
    assert size["VmLck"] < MOST_BYTES
    assert (size["VmLck"] > 0) == ("memory locked" in scheduling(rig))
    end(rig.supervisor)
    imported = {name.partition(".")[0] for name in json.loads(modules.read_text())}
    assert "numpy" in imported
    assert not imported & NOT_FOR_THE_LOOP


def test_ticks_do_not_wait_for_memory(witnessed):
    rig, _ = witnessed
    if "memory locked" not in scheduling(rig):
        pytest.skip("this user may not lock memory")
    before, ticks, end_s = page_faults(rig.supervisor.pid), 0, time.monotonic() + 10.0
    while time.monotonic() < end_s:
        telemetry = rig.receive(0.5)
        ticks += 0 if telemetry is None else len(telemetry.ticks)
    minor, major = (
        now - then for now, then in zip(page_faults(rig.supervisor.pid), before, strict=True)
    )
    assert ticks > 400
    assert major == 0
    assert minor < 0.1 * ticks
