"""The recorder of the swarm."""

import pytest

from benchmarks.swarm.recorder import SwarmRecorder, installed
from fitctl.daemon.last_records import finish_log
from fitctl.logging.queue import RecordQueue
from fitctl.logging.records import Event


@pytest.fixture
def queue(time):
    with installed(time):
        yield RecordQueue("swarm", 50)


def offer(queue, time, count):
    for number in range(count):
        record = Event(time_s=time.now_s(), severity="info", source="test", message=str(number))
        queue.offer(record)


def test_a_recorder_that_dies_loses_nothing_that_was_not_confirmed(time, queue):
    recorder = SwarmRecorder(time, queue)
    for _ in range(6):
        offer(queue, time, 7)
        time.run_until(time.now_s() + 0.2)
        recorder.die()
        time.run_until(time.now_s() + 1.5)
        queue.pump()
    for _ in range(20):
        queue.pump()
        time.run_until(time.now_s() + 0.2)

    assert recorder.written == set(range(42))
    assert recorder.unaccounted(queue.offered) == ""


def on_a_full_disk(queue, time):
    recorder = SwarmRecorder(time, queue)
    recorder.disk_is_full = True
    for _ in range(10):
        offer(queue, time, 10)
        time.run_until(time.now_s() + 1.0)
    return recorder


def test_what_a_full_disk_keeps_out_is_counted(time, queue):
    recorder = on_a_full_disk(queue, time)

    assert queue.lost > 0
    assert recorder.unaccounted(queue.offered) == ""


def test_a_record_that_nobody_counts_is_noticed(time, queue):
    recorder = on_a_full_disk(queue, time)
    queue.lost = 0

    assert "0 counted" in recorder.unaccounted(queue.offered)


def test_a_recorder_that_is_stuck_writes_all_when_it_goes_on(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    recorder.stuck_until_s = time.now_s() + 3.0
    offer(queue, time, 30)
    time.run_until(3.9)
    assert recorder.waits_since(30) == 30
    for _ in range(6):
        queue.pump()
        time.run_until(time.now_s() + 0.5)

    assert recorder.waits_since(30) == 0
    assert recorder.written == set(range(30))


def test_a_recorder_stands_still_with_its_machine(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    offer(queue, time, 5)
    time.stall(2.0)
    time.run_until(2.9)
    assert recorder.written == set()
    time.run_until(4.0)

    assert recorder.written == set(range(5))


def finish(time, recorder):
    """What is missing at the end and was not reported."""
    found = []
    time.spawn(lambda: found.append(recorder.finish()), "main")
    time.run_until(time.now_s() + 30.0)
    (unreported,) = found
    return unreported


def test_at_the_end_everything_is_written(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    offer(queue, time, 40)

    assert finish(time, recorder) == ""
    assert recorder.written == set(range(40))
    assert not recorder.running


@pytest.mark.parametrize("trouble", ["stuck", "full disk", "dead"])
@pytest.mark.parametrize("reports", [True, False])
def test_what_is_not_written_at_the_end_must_be_reported(
    monkeypatch, time, queue, trouble, reports
):
    if not reports:
        monkeypatch.setattr(
            "benchmarks.swarm.recorder.finish_log",
            lambda queue, recorder, _report: finish_log(queue, recorder, lambda _line: None),
        )
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    recorder.stuck_until_s = 100.0 if trouble == "stuck" else 0.0
    recorder.disk_is_full = trouble == "full disk"
    if trouble == "dead":
        recorder.die()
    offer(queue, time, 40)
    unreported = finish(time, recorder)

    assert recorder.written == set()
    assert not recorder.running
    expected = "" if reports else "at the end 40 are not written; reported: nothing"
    # Records that a dead recorder was never sent count as lost.
    assert unreported == ("" if trouble == "dead" else expected)
