from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from cia402_bench import Bench
from serial.urlhandler import protocol_socket

from fitctl import config
from fitctl.drivers.cia402.driver import Cia402Amplifiers


@pytest.fixture(autouse=True)
def _no_pause_after_close(monkeypatch):
    # pyserial sleeps 0.3 s after closing a socket, for servers that are slow to accept again.
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda _seconds: None))


@pytest.fixture
def siderostat() -> config.Siderostat:
    rig = config.load_rig(config.default_rig_path())
    return rig.loops["right"].siderostat


@pytest.fixture
def bench(siderostat) -> Iterator[Bench]:
    bench = Bench(siderostat)
    yield bench
    bench.close()


@pytest.fixture
def amplifiers(bench):
    amplifiers = Cia402Amplifiers(bench.siderostat)
    yield amplifiers
    amplifiers.close()
