"""Everything dies at a random moment, or the disk is full: what the log still has."""

import random
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from samples.log_samples import RUN_INFO, logs_in, start_recorder, tick, wait_until
from stalls import stalls

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.copying import recover
from fitctl.logging.queue import RecordQueue
from fitctl.logging.reading import log_info, read_records, tick_arrays
from fitctl.logging.verifying import verify

pytestmark = pytest.mark.long

SHIPPED = load_rig(default_rig_path()).logging
MAY_BE_LOST_S = 1.0

# In the supervisor's place: ticks, each with the time at which it was offered, and frames or none. At 500 a
# second a chunk is full before a flush is due; at 50 ticks a second only the flush writes it.
PACES = [("500", "frames"), ("500", "ticks only"), ("50", "ticks only")]
FEEDER = """
import sys, time
sys.path.insert(0, sys.argv[2])
from samples.log_samples import RUN_INFO, frame, tick
from fitctl.logging.queue import RecordQueue

queue = RecordQueue(sys.argv[1], 4096)
queue.offer(RUN_INFO)
picture = frame(1)
start_s = time.monotonic()
for number in range(1_000_000):
    time.sleep(max(0.0, start_s + number / float(sys.argv[3]) - time.monotonic()))
    queue.offer(tick(number, time_s=time.monotonic()))
    if sys.argv[4] == "frames":
        queue.offer(picture)
"""


def begun(folder):
    """Logs with a beginning: a recorder may be killed before it has written one."""
    return [path for path in logs_in(folder) if path.stat().st_size]


def run_and_kill(folder, after_s, pace):
    """Record until some time after the log has begun, then kill -9 both; when, and the log."""
    folder.mkdir()
    endpoint = f"ipc://{folder}/records"
    recorder = start_recorder(endpoint, folder / "logs", SHIPPED)
    samples = str(Path(__file__).parents[1])
    feeder = subprocess.Popen([sys.executable, "-c", FEEDER, endpoint, samples, *pace])
    try:
        (path,) = wait_until(lambda: begun(folder / "logs"), timeout_s=30)
        wait_until(lambda: "/fit/right/tick" in log_info(path).counts, timeout_s=30)
        time.sleep(after_s)
        killed_s = time.monotonic()
    finally:
        for process in (feeder, recorder):
            process.kill()
        for process in (feeder, recorder):
            process.wait()
        recorder.stdout.close()
    return killed_s, path


def lost_s_of_runs(tmp_path, moments_s):
    """Kill runs side by side, each at its moment; what each lost, and the machine's worst stall."""
    results = {}

    def one(number, after_s):
        results[number] = run_and_kill(tmp_path / str(number), after_s, PACES[number])

    with stalls() as stalled:
        threads = [threading.Thread(target=one, args=pair) for pair in enumerate(moments_s)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(results) == len(moments_s)
    lost_s = []
    for killed_s, path in results.values():
        ticks = tick_arrays(path, "right")
        assert list(ticks["number"]) == list(range(len(ticks["number"])))
        lost_s.append(killed_s - ticks["time_s"][-1])
        mended = path.with_name("mended.mcap")
        saved = recover(path, mended)
        assert verify(mended).problems == ()
        assert saved.records == sum(log_info(path).counts.values())
        assert log_info(mended).metadata["rig"]["name"] == "bench"
    return lost_s, stalled.worst_s


def test_a_kill_of_everything_costs_at_most_a_second(tmp_path):
    moments_s = [random.uniform(1.2, 2.2) for _ in PACES]
    lost_s, stalled_s = lost_s_of_runs(tmp_path, moments_s)
    assert max(lost_s) <= MAY_BE_LOST_S + stalled_s, (moments_s, lost_s)


@pytest.mark.slow
def test_thirty_kills_of_everything_cost_at_most_a_second_each(tmp_path):
    for batch in range(10):
        folder = tmp_path / f"batch{batch}"
        folder.mkdir()
        moments_s = [random.uniform(0.0, 4.0) for _ in PACES]
        lost_s, stalled_s = lost_s_of_runs(folder, moments_s)
        assert max(lost_s) <= MAY_BE_LOST_S + stalled_s, (moments_s, lost_s)


@pytest.fixture
def queue(tmp_path):
    queue = RecordQueue(f"ipc://{tmp_path}/records", 2048)
    yield queue
    queue.close(timeout_s=0.05)


def offer_for(queue, duration_s, first=0):
    """Offer 500 ticks a second; the number of the next."""
    start_s = time.monotonic()
    number = first
    while time.monotonic() < start_s + duration_s:
        queue.offer(tick(number, time_s=time.monotonic()))
        number += 1
        time.sleep(max(0.0, start_s + (number - first) / 500 - time.monotonic()))
    return number


def record_what_waits(queue, endpoint, folder):
    """One more recorder, until nothing waits."""
    recorder = start_recorder(endpoint, folder, SHIPPED)
    try:
        wait_until(lambda: (queue.pump(), queue.waiting == 0)[1], timeout_s=20)
    finally:
        recorder.terminate()
        recorder.wait(20)
        recorder.stdout.close()


def numbers(path):
    return [entry.message.number for entry in read_records(path, ["/fit/right/tick"])]


def test_a_full_disk_costs_nothing_once_there_is_room_again(queue, tmp_path):
    """The recorder says why it ends; what it had written stays, and what it had not goes to the next."""
    folder = tmp_path / "logs"
    queue.offer(RUN_INFO)
    first = start_recorder(f"ipc://{tmp_path}/records", folder, SHIPPED, stderr=subprocess.PIPE)
    try:
        wait_until(lambda: begun(folder), timeout_s=20)
        count = offer_for(queue, 1.5)
        (path,) = logs_in(folder)
        resource.prlimit(first.pid, resource.RLIMIT_FSIZE, (path.stat().st_size + 5000,) * 2)
        full_s = time.monotonic()
        with stalls() as stalled:
            while first.poll() is None and time.monotonic() < full_s + 20:
                count = offer_for(queue, 0.1, count)
        assert first.returncode == 1  # `fitctl record` turns it into one line and status 2
        assert (
            f"{path}: cannot be written: File too large; make room" in first.stderr.read().decode()
        )
    finally:
        first.kill()
        first.wait()
        first.stdout.close()
        first.stderr.close()
    times_s = tick_arrays(path, "right")["time_s"]
    assert full_s - times_s[-1] <= MAY_BE_LOST_S + stalled.worst_s
    record_what_waits(queue, f"ipc://{tmp_path}/records", folder)
    files = [numbers(path) for path in logs_in(folder)]
    assert set().union(*files) == set(range(count))
    assert queue.lost == 0


def test_recorders_killed_again_and_again_lose_nothing_while_the_supervisor_lives(queue, tmp_path):
    folder = tmp_path / "logs"
    queue.offer(RUN_INFO)
    count = 0
    for _ in range(2):
        recorder = start_recorder(f"ipc://{tmp_path}/records", folder, SHIPPED)
        known = len(begun(folder))
        while len(begun(folder)) == known:
            count = offer_for(queue, 0.05, count)
        count = offer_for(queue, random.uniform(0.0, 0.8), count)
        recorder.kill()
        recorder.wait()
        recorder.stdout.close()
    record_what_waits(queue, f"ipc://{tmp_path}/records", folder)
    assert set().union(*(numbers(path) for path in begun(folder))) == set(range(count))
    assert queue.lost == 0
