"""What becomes of the last records of a run, whatever state its recorder is in."""

import time

import pytest

from fitctl.daemon import last_records
from fitctl.daemon.last_records import finish_log
from fitctl.logging.queue import RecordQueue, RecordReceiver
from fitctl.logging.records import Event


class Recorder:
    """Stands in for the recorder's process; `course` is gone through a step each time somebody looks at it."""

    def __init__(self, course):
        self._course = course(self)
        self._running = True
        self.told_to_end = self.killed = False

    @property
    def running(self):
        if self._running:
            self._running = next(self._course, None) is not None
        return self._running

    def ask_to_end(self):
        self.told_to_end = True

    def end(self, timeout_s):
        self.killed, self._running = self._running, False


@pytest.fixture
def endpoint(tmp_path):
    return f"ipc://{tmp_path}/records"


@pytest.fixture
def queue(endpoint):
    queue = RecordQueue(endpoint, 100)
    for number in range(10):
        queue.offer(Event(time_s=number, severity="info", source="test", message="x"))
    yield queue
    queue.close()


def finished(queue, recorder):
    """What is said while the log is finished."""
    said = []
    finish_log(queue, recorder, said.append)
    return said


def test_a_recorder_that_comes_late_is_not_told_to_end_before_it_is_there(queue, endpoint):
    told = []

    def late(recorder):
        for _ in range(20):
            told.append(recorder.told_to_end)
            yield "starting"
        receiver = RecordReceiver(endpoint)
        for last in range(10):
            while receiver.receive(0) is None:
                yield f"waiting for record {last}"
        while not recorder.told_to_end:
            yield "has everything"
        receiver.confirm(9)
        receiver.close()

    said = finished(queue, Recorder(late))

    assert said == []
    assert not any(told)


def test_records_that_a_dead_recorder_did_not_take_are_counted_at_once(queue):
    begun_s = time.monotonic()

    (said,) = finished(queue, Recorder(lambda _: iter(())))

    assert "the recorder did not confirm the last 10 of 10 records" in said
    assert time.monotonic() - begun_s < last_records.HELLO_S / 3


def test_a_recorder_that_confirms_a_part_leaves_the_rest_counted(queue, endpoint):
    def takes_four(recorder):
        receiver = RecordReceiver(endpoint)
        while not recorder.told_to_end:
            yield "recording"
        receiver.confirm(3)
        receiver.close()

    (said,) = finished(queue, Recorder(takes_four))

    assert "did not confirm the last 6 of 10 records" in said


def test_a_recorder_that_was_there_and_hangs_has_its_five_seconds_and_no_more(
    queue, endpoint, monkeypatch
):
    monkeypatch.setattr(last_records, "_SILENT_S", 0.1)
    monkeypatch.setattr(last_records, "END_S", 0.3)

    def hangs(_):
        receiver = RecordReceiver(endpoint)
        while receiver.receive(0) is None:
            yield "here it is"
        while True:
            yield "hanging"

    begun_s = time.monotonic()
    (said,) = finished(queue, Recorder(hangs))

    assert "did not end within 0.3 s and was killed" in said
    assert time.monotonic() - begun_s < last_records.HELLO_S / 3


def test_a_recorder_that_never_comes_is_waited_for_no_longer_than_its_time(queue, monkeypatch):
    monkeypatch.setattr(last_records, "_SILENT_S", 0.1)
    monkeypatch.setattr(last_records, "HELLO_S", 0.2)
    monkeypatch.setattr(last_records, "END_S", 0.1)

    def hangs(_):
        while True:
            yield "starting"

    recorder = Recorder(hangs)
    waiting, said = finished(queue, recorder)

    assert "waiting for the recorder" in waiting
    assert recorder.killed
    assert "did not end within 0.1 s and was killed" in said
    assert "the last 10 of 10 records" in said
