import signal
import subprocess
import sys
import threading
import time

import msgspec
import pytest
import zmq
from samples.log_samples import (
    RUN_INFO,
    SETTINGS,
    logs_in,
    recorder_command,
    start_recorder,
    tick,
    wait_until,
)

from fitctl.logging.errors import LogError
from fitctl.logging.queue import RecordQueue
from fitctl.logging.reading import log_info, read_records, tick_arrays
from fitctl.logging.recorder import record
from fitctl.logging.records import RECORD_VERSION, Envelope


@pytest.fixture
def endpoint(tmp_path):
    return f"ipc://{tmp_path}/records"


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "logs"


@pytest.fixture
def queue(endpoint):
    queue = RecordQueue(endpoint, SETTINGS.queue_records)
    yield queue
    queue.close(timeout_s=0.05)


@pytest.fixture
def recorder(endpoint, folder):
    """Starts recorder processes; none outlives the test."""
    started = []

    def start():
        started.append(start_recorder(endpoint, folder))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def confirmed(queue):
    queue.pump()
    return queue.waiting == 0


def numbers(path):
    return list(tick_arrays(path, "right")["number"])


def events(path):
    return [entry.message.message for entry in read_records(path, ["/fit/events"])]


@pytest.mark.long
def test_everything_offered_is_in_the_finished_log(queue, recorder, folder):
    process = recorder()
    queue.offer(RUN_INFO)
    for number in range(100):
        queue.offer(tick(number))
    queue.close(timeout_s=10)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    (path,) = logs_in(folder)
    info = log_info(path)
    assert info.finished
    assert info.metadata["rig"]["name"] == "bench"
    assert numbers(path) == list(range(100))
    assert events(path) == []
    last_status = list(read_records(path, ["/fit/recorder/status"]))[-1].message
    assert (last_status.records, last_status.lost) == (101, 0)
    assert process.stdout.read().splitlines()[-1] == b"101 0"


@pytest.mark.long
def test_a_killed_recorder_leaves_its_flushes_and_its_successor_gets_the_rest(
    queue, recorder, folder
):
    first = recorder()
    queue.offer(RUN_INFO)
    for number in range(50):
        queue.offer(tick(number))
    wait_until(lambda: confirmed(queue))
    for number in range(50, 80):
        queue.offer(tick(number))
    first.kill()
    first.wait()
    for number in range(80, 100):
        queue.offer(tick(number))
    second = recorder()
    wait_until(lambda: confirmed(queue))
    second.send_signal(signal.SIGTERM)
    assert second.wait(10) == 0

    cut, finished = sorted(logs_in(folder), key=lambda path: log_info(path).finished)

    assert not log_info(cut).finished
    assert set(range(50)) <= set(numbers(cut))
    assert set(numbers(cut)) | set(numbers(finished)) == set(range(100))
    assert log_info(finished).metadata == log_info(cut).metadata
    assert queue.lost == 0


@pytest.mark.long
def test_what_overflowed_while_no_recorder_ran_is_counted_in_the_log(queue, recorder, folder):
    size = SETTINGS.queue_records
    for number in range(size + 30):
        queue.offer(tick(number))
    process = recorder()
    wait_until(lambda: confirmed(queue))
    queue.offer(tick(1000))
    wait_until(lambda: confirmed(queue))
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    (path,) = logs_in(folder)
    assert queue.lost == 30
    assert list(read_records(path, ["/fit/recorder/status"]))[-1].message.lost == 30
    assert any("30 records were lost" in line for line in events(path))
    assert numbers(path) == [*range(size), 1000]


def test_a_recorder_whose_parent_dies_finishes_its_log(queue, endpoint, folder):
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import subprocess, sys; process = subprocess.Popen(sys.argv[1:]);"
            "print(process.pid, flush=True); sys.stdin.read()",
            *recorder_command(endpoint, folder),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with parent:
        pid = int(parent.stdout.readline())
        try:
            for number in range(10):
                queue.offer(tick(number))
            wait_until(lambda: confirmed(queue))
            parent.kill()
            parent.wait()
            wait_until(lambda: log_info(logs_in(folder)[0]).finished)
        finally:
            wait_until(lambda: not running(pid), timeout_s=5)
    assert numbers(logs_in(folder)[0]) == list(range(10))


def running(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def record_what(endpoint, folder, messages):
    """Let the recorder receive these raw messages, then stop it, in this process."""
    stop = threading.Event()
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.bind(endpoint)
        thread = threading.Thread(
            target=record,
            args=(endpoint, SETTINGS),
            kwargs={"rig_name": "bench", "folder": folder, "stop": stop},
        )
        thread.start()
        try:
            recorder, hello = socket.recv_multipart()
            for data in messages:
                socket.send_multipart([recorder, data])
        finally:
            stop.set()
            thread.join(10)
    assert not thread.is_alive()
    assert msgspec.msgpack.decode(hello) == -1
    return logs_in(folder)[0]


def envelope(sequence, content, version=RECORD_VERSION):
    return msgspec.msgpack.encode(Envelope(version, sequence, content))


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (b"", "Input data was truncated"),
        (b"\xc1garbage", "MessagePack data is malformed"),
        (msgspec.msgpack.encode({"a": 1}), "Expected `array`, got `object`"),
        (msgspec.msgpack.encode([1, 1, {"type": "Tock"}]), "Invalid value 'Tock'"),
        (envelope(1, tick(1), version=2), "version 2, but this recorder knows version 1"),
        (msgspec.msgpack.encode([2, "new"]), "version 2, but this recorder knows version 1"),
        (envelope(1, tick(1, time_s=float("inf"))), "time_s = inf is no time"),
    ],
)
def test_a_message_that_is_no_record_is_reported_and_passed_over(endpoint, folder, bad, complaint):
    path = record_what(endpoint, folder, [envelope(0, tick(0)), bad, envelope(2, tick(2))])
    assert numbers(path) == [0, 2]
    (line,) = (line for line in events(path) if "were no records" in line)
    assert complaint in line


def test_draining_ends_even_if_records_keep_coming_and_the_log_says_so(
    endpoint, folder, monkeypatch
):
    monkeypatch.setattr("fitctl.logging.recorder.DRAIN_S", 0.5)
    monkeypatch.setattr("fitctl.logging.recorder._QUIET_S", 5.0)  # a stall is no end of records
    stop = threading.Event()
    stop.set()
    queue = RecordQueue(endpoint, SETTINGS.queue_records)
    thread = threading.Thread(
        target=record,
        args=(endpoint, SETTINGS),
        kwargs={"rig_name": "bench", "folder": folder, "stop": stop},
    )
    thread.start()
    start_s = time.monotonic()
    while thread.is_alive() and time.monotonic() < start_s + 10:
        queue.offer(tick(1))
        time.sleep(0.01)
    queue.close(timeout_s=0.05)
    thread.join()
    assert time.monotonic() - start_s < 5
    (path,) = logs_in(folder)
    assert log_info(path).finished
    assert any("some may be missing at the end" in line for line in events(path))


def test_a_folder_that_cannot_be_made_is_named(tmp_path, endpoint):
    (tmp_path / "file").touch()
    with pytest.raises(LogError, match=r"file/logs: cannot be made.*logging\.folder"):
        record(
            endpoint,
            SETTINGS,
            rig_name="bench",
            folder=tmp_path / "file" / "logs",
            stop=threading.Event(),
        )
