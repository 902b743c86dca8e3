"""The supervisor under everything at once, on virtual time: a few fixed seeds of `make swarm`."""

import json
import os
import subprocess
import sys

import msgspec
import pytest

from benchmarks.swarm import __main__ as swarm_main
from benchmarks.swarm import run as swarm_run
from benchmarks.swarm.__main__ import finding, met, run_and_shrink, run_seed
from benchmarks.swarm.happenings import Order, Plan, Strike
from benchmarks.swarm.past import put_back
from benchmarks.swarm.plan import plan_of
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.shrink import shrunk, shrunk_from
from benchmarks.swarm.threads import (
    VirtualEvent,
    VirtualExecutor,
    VirtualLock,
    VirtualThreading,
)
from fitctl.messages.commands import Recover, Release, Stop

DIGEST = """
import msgspec
from benchmarks.swarm.plan import plan_of
from benchmarks.swarm.run import run_plan
plan = plan_of({seed})
some = [happening for happening in plan.happenings if happening.at_s < 20.0]
print(run_plan(msgspec.structs.replace(plan, duration_s=20.0, happenings=some)).digest)
"""


OVERTAKEN = Plan(
    seed=1,
    rig="fit-mock.toml",
    settings=[],
    duration_s=2.0,
    happenings=[
        Order(at_s=0.1, who="ada", command=Stop()),
        Order(at_s=0.5, who="ada", command=Recover()),
        Order(at_s=0.6, who="ada", command=Stop()),
    ],
)


@pytest.mark.parametrize("seed", [2, 16])  # of two kinds of amplifiers, and quick
def test_nothing_is_violated_whatever_fails(seed):
    assert run_plan(plan_of(seed)).violations == []


def digest(seed, hash_seed):
    return subprocess.run(
        [sys.executable, "-c", DIGEST.format(seed=seed)],
        env=os.environ | {"PYTHONHASHSEED": hash_seed},
        capture_output=True,
        text=True,
        check=True,
    ).stdout


@pytest.mark.long
def test_the_same_seed_gives_the_same_records_in_any_process():
    assert digest(7, "1") == digest(7, "2") != digest(8, "1")


@pytest.mark.long
def test_a_defect_of_the_past_that_is_put_back_is_found():
    with put_back("stop-while-opening"):
        violation = run_plan(OVERTAKEN).violations[0]
    assert violation.invariant == "a stop has the last word"
    assert run_plan(OVERTAKEN).violations == []


IDLE = [Order(at_s=0.01 * number, who="ada", command=Release()) for number in range(6, 9)]
LONGER = msgspec.structs.replace(OVERTAKEN, happenings=[*IDLE, *OVERTAKEN.happenings])


@pytest.mark.long
def test_a_plan_is_shrunk_to_what_violates():
    with put_back("stop-while-opening"):
        assert shrunk(LONGER).happenings == OVERTAKEN.happenings


@pytest.fixture
def trials(monkeypatch):
    """The plans that are run from here on to shrink one."""
    tried = []

    def counted(plan):
        tried.append(plan)
        return run_plan(plan)

    monkeypatch.setattr("benchmarks.swarm.shrink.run_plan", counted)
    return tried


@pytest.mark.long
def test_shrinking_ends_after_so_many_runs(trials):
    with put_back("stop-while-opening"):
        shrunk(LONGER, most_runs=2)

    assert len(trials) == 1 + 2  # the first finds the violation


@pytest.mark.long
def test_shrinking_ends_with_the_run_that_is_under_way_when_a_signal_comes(trials):
    with put_back("stop-while-opening"):
        shrunk_from(LONGER, run_plan(LONGER).violations[0], is_over=lambda: len(trials) == 1)

    assert len(trials) == 1


@pytest.mark.long
def test_what_a_seed_violates_is_shrunk_at_once(monkeypatch):
    monkeypatch.setattr(swarm_main, "plan_of", lambda seed: OVERTAKEN)
    with put_back("stop-while-opening"):
        found = finding(run_and_shrink(1))

    assert found["replay"] == "python -m benchmarks.swarm --replay 1"
    assert found["violated"][0]["invariant"] == "a stop has the last word"
    assert [happening["type"] for happening in json.loads(json.dumps(found))["remain"]] == [
        "order"
    ] * len(OVERTAKEN.happenings)


def fails(*_args, **_kwargs):
    msg = "a mistake of the swarm"
    raise ValueError(msg)


@pytest.mark.parametrize(
    ("owner", "name"), [(swarm_main, "plan_of"), (swarm_run, "load_rig"), (swarm_run, "_recover")]
)
def test_an_exception_of_the_run_itself_is_a_violation_of_its_seed(monkeypatch, owner, name):
    quiet = msgspec.structs.replace(OVERTAKEN, duration_s=0.1, happenings=[])
    monkeypatch.setattr(swarm_main, "plan_of", lambda seed: quiet)
    monkeypatch.setattr(owner, name, fails)
    found = finding(run_and_shrink(7))

    assert found["violated"][0]["invariant"] == "no exception escapes"
    assert "a mistake of the swarm" in found["violated"][0]["detail"]
    assert run_seed(7).result.lasted_s == 0.0


@pytest.mark.long
def test_a_swarm_counts_each_run_that_has_begun_and_ends_if_a_process_dies(monkeypatch, capfd):
    quiet = msgspec.structs.replace(OVERTAKEN, duration_s=0.1, happenings=[])

    def planned(seed):
        if seed % 1_000_000 == 1:
            fails()
        return msgspec.structs.replace(quiet, seed=seed)

    monkeypatch.setattr(swarm_main, "plan_of", planned)  # inherited by the processes
    found = swarm_main.swarm(5, hours=1e-9, jobs=1)

    assert found["runs"] == 2
    assert [violation["seed"] for violation in found["violations"]] == [5_000_001]
    assert "5000001 violates: no exception escapes" in capfd.readouterr().err

    monkeypatch.setattr(swarm_main, "plan_of", lambda _seed: os._exit(1))
    (violation,) = swarm_main.swarm(5, hours=1.0, jobs=1)["violations"]
    assert "5000000" in violation["violated"][0]["detail"]


def test_what_is_called_at_a_time_and_fails_reaches_no_thread(time):
    seen = []

    def thread():
        time.sleep_until(2.0)
        seen.append(time.now_s())

    time.spawn(thread, "waits")
    time.call_at(1.0, fails)
    time.run_until(3.0)

    assert seen == [2.0]
    assert [(name, type(error)) for name, error in time.escaped] == [("fails", ValueError)]


def test_a_plan_has_commands_and_faults_in_their_order():
    plan = plan_of(6)

    times_s = [happening.at_s for happening in plan.happenings]
    assert times_s == sorted(times_s)
    assert {type(happening) for happening in plan.happenings} >= {Order, Strike}


def test_threads_go_on_in_the_order_of_their_deadlines(time):
    seen = []

    def thread(name, *deadlines_s):
        for deadline_s in deadlines_s:
            time.sleep_until(deadline_s)
            seen.append((name, time.now_s()))

    time.spawn(lambda: thread("a", 1.0, 4.0), "a")
    time.spawn(lambda: thread("b", 2.0, 3.0), "b")
    time.run_until(10.0)

    assert seen == [("a", 1.0), ("b", 2.0), ("b", 3.0), ("a", 4.0)]
    assert time.now_s() == 10.0


def test_a_wait_ends_when_its_event_is_set_or_its_time_is_over(time):
    event, seen = VirtualEvent(time), []

    def wait(timeout_s):
        seen.append((event.wait(timeout_s), time.now_s()))

    time.spawn(lambda: wait(1.0), "short")
    time.spawn(lambda: wait(None), "long")
    time.call_at(2.0, event.set)
    time.run_until(3.0)

    assert seen == [(False, 1.0), (True, 2.0)]


def test_a_lock_has_one_holder_at_a_time(time):
    lock, seen = VirtualLock(time), []

    def hold(name):
        with lock:
            time.sleep(1.0)
            seen.append((name, time.now_s()))

    for name in "abc":
        time.spawn(lambda name=name: hold(name), name)
    time.run_until(10.0)

    assert seen == [("a", 1.0), ("b", 2.0), ("c", 3.0)]


def test_an_executor_leaves_out_what_was_cancelled_before_it_began(time):
    executor, seen = VirtualExecutor(time, "design"), []
    begun = executor.submit(time.sleep, 1.0)
    waiting = [executor.submit(seen.append, number) for number in (1, 2)]
    time.run_until(0.5)

    assert not begun.cancel()
    assert waiting[0].cancel()
    time.run_until(2.0)
    assert begun.done()
    assert seen == [2]


def test_an_executor_does_one_thing_after_the_other(time):
    executor, seen = VirtualExecutor(time, "devices"), []

    def fail():
        raise OSError("gone")

    def ask():
        futures = [executor.submit(time.sleep, 1.0), executor.submit(fail)]
        with pytest.raises(TimeoutError):
            futures[0].result(timeout=0.5)
        seen.append((futures[0].result(), str(futures[1].exception()), time.now_s()))

    time.spawn(ask, "asks")
    time.run_until(5.0)

    assert seen == [(None, "gone", 1.0)]


def test_an_exception_that_ends_a_thread_is_kept(time):
    thread = VirtualThreading(time).Thread(target=lambda: 1 // 0, name="divides")
    thread.start()
    time.run_until(1.0)

    assert not thread.is_alive()
    assert [(name, type(error)) for name, error in time.escaped] == [("divides", ZeroDivisionError)]


@pytest.mark.long
def test_a_stop_is_obeyed_while_a_device_does_not_answer():
    happenings = [
        Order(at_s=0.1, who="ada"),
        Strike(at_s=1.0, device="right D/A", fault="deaf", lasts_s=5.0),
        Order(at_s=1.01, who="ada", command=Stop()),
    ]
    result = run_plan(msgspec.structs.replace(OVERTAKEN, duration_s=10.0, happenings=happenings))

    assert result.violations == []
    assert result.modes["SAFE"] >= 1


@pytest.mark.long
def test_the_command_prints_one_object_and_ends_well_where_nothing_is_violated():
    ran = subprocess.run(
        [sys.executable, "-m", "benchmarks.swarm", "--hours", "0.01", "--seed", "1", "--jobs", "1"],
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(ran.stdout)

    assert ran.stderr.startswith("seed 1\n")
    assert found["violations"] == []
    assert found["simulated_hours"] >= 0.01
    assert sum(found["happenings"].values()) > 0
    assert found["kinds_that_met_within_1_s"] == len(found["pairs_that_met_within_1_s"])


def test_happenings_within_a_second_have_met():
    orders = [
        Order(at_s=at_s, who="ada", command=command)
        for at_s, command in ((1.0, Stop()), (1.9, Release()), (2.5, Recover()))
    ]
    plan = msgspec.structs.replace(OVERTAKEN, happenings=orders)

    assert list(met(plan)) == [("Release", "Stop"), ("Recover", "Release")]


def test_a_machine_that_stands_still_holds_every_thread_and_no_device(time):
    seen = []

    def thread():
        time.sleep_until(1.0)
        seen.append(("thread", time.now_s()))

    time.spawn(thread, "waits")
    time.call_at(0.5, lambda: time.stall(2.0))
    time.call_at(1.5, lambda: seen.append(("device", time.now_s())))
    time.run_until(5.0)

    assert seen == [("device", 1.5), ("thread", 2.5)]


def test_a_process_that_stands_still_alone_holds_its_own_threads(time):
    seen = []

    def waits(name):
        time.sleep_until(1.0)
        seen.append((name, time.now_s()))

    time.new_process()
    time.spawn(lambda: waits("its own"), "its own")
    time.spawn(lambda: waits("another's"), "another's", apart=True)
    time.call_at(0.5, lambda: time.stall(2.0, alone=True))
    time.run_until(5.0)

    assert seen == [("another's", 1.0), ("its own", 2.5)]
    assert time.awake_s() == 3.0


def test_the_threads_of_a_process_that_is_killed_never_go_on(time):
    seen = []

    def thread():
        time.sleep_until(1.0)
        seen.append("thread")

    time.new_process()
    time.spawn(thread, "waits")
    time.call_at(0.5, time.kill_process)
    time.run_until(2.0)

    assert seen == []


def test_a_thread_that_is_woken_as_its_time_limit_comes_waits_its_next_wait_in_full(time):
    event, seen = VirtualEvent(time), []

    def waits():
        event.wait(1.0)
        event.clear()
        for _ in range(2):
            event.wait(5.0)
            seen.append(time.now_s())

    time.call_at(1.0, event.set)  # in the instant at which the wait is over
    time.spawn(waits, "waits")
    time.run_until(12.0)

    assert seen == [6.0, 11.0]


def test_a_thread_that_is_woken_twice_in_one_instant_goes_on_once(time):
    first, second, seen = VirtualEvent(time), VirtualEvent(time), []

    def waits():
        first.wait(1.0)
        second.wait(3.0)
        seen.append(time.now_s())

    def sets():
        first.set()
        first.set()

    time.spawn(waits, "waits")
    time.call_at(0.5, sets)
    time.run_until(5.0)

    assert seen == [3.5]
