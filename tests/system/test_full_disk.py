"""The disk of the logs is full while a star is held, and then has room again."""

import resource
import time
from pathlib import Path

import pytest

from fitctl.logging.reading import log_info, read_records, tick_arrays
from fitctl.logging.verifying import verify

from .conftest import NEAR, running

pytestmark = [pytest.mark.timeout(300), pytest.mark.fault]
QUEUE_RECORDS = 300  # what some three seconds bring
MAY_BE_LOST_S = 1.0


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path, NEAR, f"logging.queue_records={QUEUE_RECORDS}") as rig:
        yield rig


def limit_files(process, size):
    """No file that this process or one that it starts writes may grow beyond this."""
    hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, hard))


def test_a_full_disk_is_an_event_losses_are_counted_and_the_star_is_held(rig):
    rig.to_vernier()
    seen = rig.follow(lambda t: t.recorder is not None and t.recorder.records > 300)
    path = Path(seen[-1].recorder.path)
    limit_files(rig.supervisor, 4000)  # for the recorders that it will start
    limit_files(rig.recorder(), path.stat().st_size + 5000)
    full_s = time.monotonic()

    seen = rig.follow(lambda t: t.records_lost > 200, limit_s=30.0)

    errors = [e for t in seen for e in t.events if e.source == "recorder" and e.severity == "error"]
    assert f"{path}: cannot be written: File too large; make room" in errors[0].message
    assert all(t.loops[0].mode == "VERNIER" for t in seen)
    ticks = tick_arrays(path, "right")
    timing = {t.time_s: t for telemetry in seen for t in telemetry.timing}.values()
    stalled_s = sum(t.stalls * t.worst_stall_s for t in timing)
    assert full_s - ticks["time_s"][-1] <= MAY_BE_LOST_S + stalled_s

    limit_files(rig.supervisor, resource.RLIM_INFINITY)
    lost = seen[-1].records_lost
    seen = rig.follow(lambda t: t.recorder is not None and t.recorder.lost >= lost, limit_s=40.0)
    assert all(t.loops[0].mode == "VERNIER" for t in seen)
    last = Path(seen[-1].recorder.path)
    rig.follow(lambda t: t.recorder.records > seen[-1].recorder.records + 100)
    rig.close()

    assert log_info(last).finished
    assert verify(last).problems == ()
    assert verify(last).lost >= lost
    losses = [entry.message for entry in read_records(last, ["/fit/losses"])]
    assert losses[-1].records_lost >= lost
    assert losses[-1].records_offered > losses[0].records_offered > QUEUE_RECORDS
    texts = [entry.message.message for entry in read_records(last, ["/fit/events"])]
    assert any("records were lost on their way to the log" in text for text in texts)
