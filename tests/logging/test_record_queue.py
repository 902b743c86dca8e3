import time

import msgspec
import pytest
import zmq
from samples.log_samples import RUN_INFO, tick, wait_until

from fitctl.logging.errors import LogError
from fitctl.logging.queue import RecordQueue, RecordReceiver
from fitctl.logging.records import RECORD_VERSION, Envelope

SIZE = 20
decode = msgspec.msgpack.Decoder(Envelope).decode


@pytest.fixture
def endpoint(tmp_path):
    return f"ipc://{tmp_path}/records"


@pytest.fixture
def queue(endpoint):
    queue = RecordQueue(endpoint, SIZE)
    yield queue
    queue.close(timeout_s=0.05)


@pytest.fixture
def recorders(endpoint):
    """Starts recorders; all are closed at the end."""
    started = []

    def start():
        started.append(RecordReceiver(endpoint))
        return started[-1]

    yield start
    for receiver in started:
        receiver.close()


def next_of(queue, receiver, number):
    """The next envelopes to arrive, while the queue goes on as in its loop."""
    envelopes = []

    def arrived():
        queue.pump()
        while (data := receiver.receive(0)) is not None:
            envelopes.append(decode(data))
        return len(envelopes) >= number

    wait_until(arrived)
    return envelopes


def sequences(envelopes):
    return [envelope.sequence for envelope in envelopes]


def waiting(queue):
    queue.pump()
    return queue.waiting


def test_records_arrive_numbered_and_in_order(queue, recorders):
    recorder = recorders()
    for number in range(4):
        queue.offer(tick(number))
    assert next_of(queue, recorder, 4) == [
        Envelope(RECORD_VERSION, number, tick(number)) for number in range(4)
    ]


def test_on_the_wire_the_version_comes_first_for_recorders_of_other_versions():
    wire = msgspec.msgpack.decode(msgspec.msgpack.encode(Envelope(RECORD_VERSION, 7, tick(0))))
    assert wire[:2] == [RECORD_VERSION, 7]


def test_what_is_offered_before_the_recorder_comes_is_kept_up_to_the_size(queue, recorders):
    for number in range(SIZE + 5):
        queue.offer(tick(number))
    assert queue.lost == 5
    assert sequences(next_of(queue, recorders(), SIZE)) == list(range(SIZE))


def test_refused_records_leave_a_gap_that_the_recorder_sees(queue, recorders):
    for number in range(SIZE + 5):
        queue.offer(tick(number))
    recorder = recorders()
    next_of(queue, recorder, SIZE)
    recorder.confirm(SIZE - 1)
    wait_until(lambda: waiting(queue) == 0)
    queue.offer(tick(99))
    assert sequences(next_of(queue, recorder, 1)) == [SIZE + 5]


def test_a_record_stays_until_it_is_confirmed(queue, recorders):
    for number in range(10):
        queue.offer(tick(number))
    recorder = recorders()
    next_of(queue, recorder, 10)
    assert queue.waiting == 10
    recorder.confirm(6)
    wait_until(lambda: waiting(queue) == 3)


def test_a_new_recorder_is_sent_the_run_and_what_none_has_confirmed(queue, recorders):
    queue.offer(RUN_INFO)
    for number in range(1, 10):
        queue.offer(tick(number))
    first = recorders()
    next_of(queue, first, 10)
    first.confirm(6)
    first.confirm(3)  # of a recorder that says so late; the later records stay confirmed
    wait_until(lambda: waiting(queue) == 3)
    first.close()

    envelopes = next_of(queue, recorders(), 4)

    assert envelopes[0].record == RUN_INFO
    assert sequences(envelopes) == [6, 7, 8, 9]


def test_records_of_the_time_between_two_recorders_are_kept(queue, recorders):
    first = recorders()
    queue.offer(tick(0))
    next_of(queue, first, 1)
    first.confirm(0)
    wait_until(lambda: waiting(queue) == 0)
    first.close()
    for number in range(1, 6):
        queue.offer(tick(number))
    assert sequences(next_of(queue, recorders(), 5)) == [1, 2, 3, 4, 5]


def test_a_recorder_that_is_gone_is_noticed_at_the_next_record(queue, recorders):
    recorder = recorders()
    queue.offer(tick(0))
    next_of(queue, recorder, 1)
    assert queue.heard
    recorder.close()

    def noticed():
        queue.offer(tick(1))
        return not queue.heard

    wait_until(noticed)
    assert queue.unsent > 0


@pytest.mark.long
def test_a_new_recorder_is_sent_nothing_that_is_confirmed_however_much_that_is(endpoint, recorders):
    many = 2000
    queue = RecordQueue(endpoint, many)
    for number in range(many):
        queue.offer(tick(number))
    first = recorders()
    next_of(queue, first, many)
    first.confirm(many - 2)
    time.sleep(0.2)
    queue.pump()  # hears it, and lets go of some
    assert queue.waiting > many // 2
    second = recorders()
    time.sleep(0.2)
    try:
        assert sequences(next_of(queue, second, 1)) == [many - 1]
        assert queue.waiting == 1
    finally:
        queue.close(timeout_s=0.05)


def test_only_the_newest_recorder_is_spoken_to(queue, recorders):
    old = recorders()
    queue.offer(tick(0))
    next_of(queue, old, 1)
    new = recorders()
    next_of(queue, new, 1)
    queue.offer(tick(1))
    assert sequences(next_of(queue, new, 1)) == [1]
    assert old.receive(0.1) is None


@pytest.mark.long
def test_a_recorder_that_hangs_costs_records_but_never_time(queue, recorders):
    recorder = recorders()
    queue.offer(tick(0))
    next_of(queue, recorder, 1)
    costs_s = []
    for record in [tick(number) for number in range(3000)]:  # to make one takes 200 times as long
        start_s = time.perf_counter()
        queue.offer(record)
        costs_s.append(time.perf_counter() - start_s)
    assert queue.lost == 3001 - SIZE
    assert sorted(costs_s)[len(costs_s) // 2] < 1e-3


def test_closing_without_a_recorder_counts_what_was_never_sent(endpoint):
    queue = RecordQueue(endpoint, SIZE)
    queue.offer(tick(0))
    queue.offer(tick(1))
    queue.close(timeout_s=0.05)
    queue.close()
    assert (queue.lost, queue.waiting, queue.unsent) == (2, 0, 0)


def test_closing_sends_what_is_still_there(endpoint, recorders):
    queue = RecordQueue(endpoint, SIZE)
    for number in range(SIZE):
        queue.offer(tick(number))
    recorder = recorders()
    queue.close(timeout_s=5.0)
    arrived = [decode(recorder.receive(1.0)).sequence for _ in range(SIZE)]
    assert arrived == list(range(SIZE))
    assert (queue.lost, queue.waiting, queue.unsent) == (0, 0, 0)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(LogError, match=r"ipc://.*/none/records: cannot be bound"):
        RecordQueue(f"ipc://{tmp_path}/none/records", SIZE)


def test_what_is_no_address_is_named():
    with pytest.raises(LogError, match="nowhere: cannot be connected to"):
        RecordReceiver("nowhere")


def test_a_confirmation_of_what_was_never_offered_is_ignored(queue, recorders):
    recorder = recorders()
    for number in range(3):
        queue.offer(tick(number))
    next_of(queue, recorder, 3)
    recorder.confirm(3)
    recorder.confirm(0)
    wait_until(lambda: waiting(queue) == 2)


@pytest.mark.parametrize(
    "answer", [b"", b"hello", b"\xc1", msgspec.msgpack.encode(2**62), b"\xff" * 9]
)
def test_an_answer_of_someone_else_changes_nothing(queue, recorders, endpoint, answer):
    recorder = recorders()
    queue.offer(tick(0))
    next_of(queue, recorder, 1)
    with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
        stranger.connect(endpoint)
        stranger.send(answer)
        time.sleep(0.05)
        queue.offer(tick(1))
        assert sequences(next_of(queue, recorder, 1)) == [1]
    assert queue.waiting == 2
