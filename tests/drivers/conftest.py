from types import SimpleNamespace

import pytest
from amplifier_back_ends import Bench
from serial.urlhandler import protocol_socket


@pytest.fixture
def bench_of(monkeypatch, in_loop):
    """Makes benches of amplifier back ends by name, and takes them down."""
    # pyserial sleeps 0.3 s after closing a socket, for servers that are slow to accept again.
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda _seconds: None))
    benches = []

    def make(name, *overrides):
        benches.append(Bench(in_loop, name, *overrides))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()
