import asyncio
import gc
import os
import random
import threading

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as fitctl.cli
os.environ.pop("FITCTL_RIG", None)  # no test may reach the rig of whoever runs it

import hypothesis
import pytest

from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.processes import name_held

gc.disable()  # until all tests are collected: what they import and their parameters stay

pytest_plugins = ["pytester", "skips", "instruments.virtual_instrument"]

# The machine itself may stand still for 100 ms: an example's time says nothing about the code. The examples
# differ from run to run, also with CI set, where Hypothesis by itself repeats the same ones.
hypothesis.settings.register_profile(
    "fitctl", hypothesis.settings.get_profile("default"), deadline=None, print_blob=True
)
hypothesis.settings.load_profile("fitctl")


PART, PART_SEED = os.environ.get("FITCTL_TESTS_PART"), os.environ.get("FITCTL_TESTS_SEED", "0")
"""How many tests are drawn at random, all without it, and what decides which."""


def pytest_report_header():
    """How to repeat a run of a part."""
    return f"{PART} tests, drawn by PART_SEED={PART_SEED}" if PART else None


@pytest.hookimpl(trylast=True)  # after markers have chosen
def pytest_collection_modifyitems(config, items):
    """Leave out what was not drawn; what is left keeps its order, so that what tests share is made once."""
    if not PART:
        return
    drawn = set(random.Random(PART_SEED).sample(items, min(int(PART), len(items))))
    config.hook.pytest_deselected(items=[item for item in items if item not in drawn])
    items[:] = [item for item in items if item in drawn]


def pytest_collection_finish():
    """Collect garbage less often: several hundred thousand objects of the tests themselves make it slow."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)
    gc.enable()


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The default rig; frozen, so all tests share it."""
    return load_rig(default_rig_path())


@pytest.fixture
def in_loop():
    """Run a coroutine in an event loop of another thread, as the testbed's process would."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield lambda coroutine: asyncio.run_coroutine_threadsafe(coroutine, loop).result(10)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)
    left = asyncio.all_tasks(loop)
    loop.close()
    assert not left


@pytest.fixture
def locks_of_its_own(monkeypatch):
    """Locks of devices that no other process takes, such as another worker, or an instrument that runs here."""
    monkeypatch.setattr(
        "fitctl.daemon.locks.name_held", lambda name: name_held(f"{name} of test {os.getpid()}")
    )
