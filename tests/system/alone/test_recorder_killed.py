"""A recorder that is killed disturbs no loop. Single ticks are judged, so that no other instrument may run."""

import statistics
from pathlib import Path

import pytest
from stalls import stalls

from fitctl.config import load_rig
from fitctl.logging.reading import log_info, tick_arrays

pytestmark = pytest.mark.timeout(300)


def with_frame(seen):
    """The ticks of telemetry that had a frame."""
    return [tick for telemetry in seen for tick in telemetry.ticks if tick.number >= 0]


def unstruck(rig, count=100):
    """So many ticks with nothing wrong."""
    seen = []
    while len(with_frame(seen)) < count:
        seen += rig.follow(lambda _: True)
    return with_frame(seen)


def typical_compute_s(ticks):
    return statistics.median(tick.compute_s for tick in ticks)


def test_killing_the_recorder_costs_no_tick_and_its_file_stays_readable(rig):
    rig.to_vernier()
    seen = rig.follow(lambda t: t.recorder is not None and t.recorder.records > 500)
    path = seen[-1].recorder.path
    recorder = rig.recorder()
    usual = unstruck(rig)
    recorder.kill()

    with stalls() as stalled:
        seen = rig.follow(
            lambda t: t.recorder is not None and t.recorder.path != path, limit_s=20.0
        )
        # Telemetry reports the timing of the last of these ticks up to a second later.
        seen += rig.follow(
            lambda t: any(timing.time_s > seen[-1].time_s for timing in t.timing), limit_s=5.0
        )

    ticks = with_frame(seen)
    timing = {t.time_s: t for telemetry in seen for t in telemetry.timing}.values()
    stalled_s = stalled.total_s + sum(t.stalls * t.worst_stall_s for t in timing)
    stood = sum(t.stalls for t in timing)  # each may cost the frame that came meanwhile
    missing = ticks[-1].number - ticks[0].number + 1 - len(ticks)
    assert missing <= stood + stalled_s * 50
    # Single ticks are late with no recorder killed too, as others use the machine: half of all are not.
    late_s = load_rig(rig.file).supervisor.late_tick_s
    assert typical_compute_s(ticks) <= typical_compute_s(usual) + late_s
    assert all(telemetry.loops[0].mode == "VERNIER" for telemetry in seen)
    assert any("recorder was killed" in e.message for t in seen for e in t.events)
    assert seen[-1].records_lost == 0
    before = tick_arrays(Path(path), "right")
    assert len(before["number"]) > 100
    assert not log_info(Path(path)).finished
