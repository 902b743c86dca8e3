"""About once a second a running supervisor logs what consoles show and no other record has."""

import itertools
import time

import msgspec
import pytest
from instruments.served import Served

from fitctl.logging.records import Snapshot
from fitctl.messages.commands import Standby
from fitctl.messages.telemetry import Unlogged


class Snapped(Served):
    def record(self, record):
        super().record(record)
        if isinstance(record, Snapshot):
            self.snapshots.append(record)


@pytest.mark.long
def test_a_snapshot_a_second_has_the_loops_with_their_readings(tmp_path):
    Snapped.snapshots = []
    served = Snapped(tmp_path)
    served.start()
    try:
        assert served.client.send(Standby()).accepted
        began_s = time.monotonic()
        served.follow(lambda _: time.monotonic() - began_s > 3.5)
    finally:
        served.close()
    times_s = [snapshot.time_s for snapshot in Snapped.snapshots]
    assert 3 <= len(times_s) <= 6
    assert min(b - a for a, b in itertools.pairwise(times_s)) >= 1.0
    state = msgspec.msgpack.decode(Snapped.snapshots[-1].state_msgpack, type=Unlogged)
    (loop,) = state.loops
    assert loop.mode == "STANDBY"
    assert {row.name for row in loop.watched} >= {"fsm_edge", "following_error"}
