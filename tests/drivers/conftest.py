import socket
import time
from types import SimpleNamespace

import pytest
from amplifier_back_ends import Bench
from serial.urlhandler import protocol_socket

SO_TIMESTAMPNS = 35


@pytest.fixture
def kernel_stamps():
    """The kernel stamps what arrives: it begins some time after the first socket wants it, later under load."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wanting:
        wanting.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        wanting.bind(("127.0.0.1", 0))
        wanting.settimeout(5)
        end_s = time.monotonic() + 5
        ancillary = []
        while not ancillary:
            assert time.monotonic() < end_s
            wanting.sendto(b"?", wanting.getsockname())
            _, ancillary, _, _ = wanting.recvmsg(1, 64)
            time.sleep(0.001)
        yield


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
