"""How things are struck: each begins something, and heals it when it is left."""

import threading
from contextlib import contextmanager

from fitctl.mocks.bench import ClearFaults, SetFault

SLOW_S = 0.015  # stopped for so long, then running for so long: half of its time


@contextmanager
def device(rig, entry):
    """A fault of the mocks."""
    kind, *value = entry.how.split()
    fault = SetFault(entry.struck, kind, value=float(value[0]) if value else None)
    rig.tell(fault)
    yield
    rig.tell(ClearFaults(entry.struck, kind))


@contextmanager
def killed(rig, entry):
    """SIGKILL; then started again by whoever started it, the recorder by its supervisor."""
    rig.process(entry.struck).kill()
    if entry.struck == "mocks":
        rig.bench_answers = False
        rig.mocks.wait()
    if entry.struck == "supervisor":
        rig.supervisor.wait()
    yield
    if entry.struck == "mocks":
        rig.restart_mocks()
    if entry.struck == "supervisor":
        rig.supervisor.stdout.close()
        rig.start_supervisor()


@contextmanager
def stopped(rig, entry):
    """SIGSTOP, then SIGCONT."""
    process = rig.process(entry.struck)
    rig.bench_answers = entry.struck != "mocks"
    process.suspend()
    try:
        yield
    finally:
        process.resume()
        rig.bench_answers = True


@contextmanager
def slowed(rig, entry):
    """SIGSTOP and SIGCONT in turn: it has half of its time, in pieces."""
    process = rig.process(entry.struck)
    ending = threading.Event()

    def slow():
        while not ending.wait(SLOW_S):
            process.suspend()
            ending.wait(SLOW_S)
            process.resume()

    thread = threading.Thread(target=slow)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()
        process.resume()


STRIKES = {"killed": killed, "stopped": stopped, "slowed": slowed}


def strike(rig, entry):
    """The entry's strike, as a context."""
    return STRIKES.get(entry.how, device)(rig, entry)
