"""What somebody with an allowed key does to a gateway's process: it ends their connection, not the process."""

import resource
import socket
import struct
import subprocess
import sys
import time
from contextlib import suppress

import msgspec
import psutil
import pytest
import zmq
import zmq.utils.monitor
from instruments.served import Served, until

from fitctl.messages.commands import Status, Stop
from fitctl.messages.endpoints import tcp_endpoint

pytestmark = pytest.mark.long

_LISTENS_S = 60.0
FLOODS = """
import sys
import zmq
endpoint, server, public, secret, message = map(bytes.fromhex, sys.argv[1:])
while True:
    one = zmq.Context.instance().socket(zmq.DEALER)
    one.curve_serverkey, one.curve_publickey, one.curve_secretkey = server, public, secret
    one.connect(endpoint.decode())
    for _ in range(500):
        one.send_multipart([b"tag", message])
    one.close(linger=20_000)
"""
_RESET_AT_CLOSE = struct.pack("ii", 1, 0)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A service whose gateway is a process, as in life."""
    served = Served(tmp_path_factory.mktemp("hostile"), tcp=True)
    served.tcp = False  # no gateway on a thread
    served.start()
    settings = ("tcp_address", "folder", "keys_folder", "command_port", "telemetry_port")
    given = [f"--set=service.{name}={getattr(served.rig.service, name)}" for name in settings]
    served.anna = served.person("anna")
    served.process = subprocess.Popen([sys.executable, "-m", "fitctl", "gateway", *given])
    until(lambda: "listening at" in " ".join(served.events()), _LISTENS_S)
    try:
        yield served
    finally:
        served.process.terminate()
        served.process.wait(20)
        served.close()


def socket_of(kind, key):
    """A socket that has a key, and is not connected."""
    one = zmq.Context.instance().socket(kind)
    one.curve_serverkey = key.server_public.encode()
    one.curve_publickey, one.curve_secretkey = key.public.encode(), key.secret.encode()
    one.setsockopt(zmq.LINGER, 0)
    one.setsockopt(zmq.SNDHWM, 100_000)
    return one


def keyed(kind, key, port):
    """A socket of an allowed key, and the descriptor of its connection."""
    one = socket_of(kind, key)
    one.setsockopt(zmq.SNDTIMEO, 2000)
    one.setsockopt(zmq.HEARTBEAT_IVL, 1)
    one.setsockopt(zmq.HEARTBEAT_TIMEOUT, 60_000)  # it does not mind silence
    with one.get_monitor_socket(zmq.EVENT_CONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED) as monitor:
        one.connect(tcp_endpoint(key.host, port))
        assert monitor.poll(20_000)
        descriptor = zmq.utils.monitor.recv_monitor_message(monitor)["value"]
        assert monitor.poll(20_000)
        one.disable_monitor()
    return one, descriptor


def flood_and_reset(kind, key, messages=10_000):
    """Send faster than anybody reads, with pings in between, and hang up so that nothing more is received."""
    port = key.command_port if kind == zmq.DEALER else key.telemetry_port
    one, descriptor = keyed(kind, key, port)
    with suppress(zmq.Again):
        for number in range(messages):
            if kind == zmq.DEALER:
                one.send_multipart([b"tag", b"garbage"])
            else:
                one.subscribe(f"topic {number}")
    time.sleep(0.05)
    with suppress(OSError):  # it was ended from the other side
        held = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
        with suppress(OSError):
            held.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_AT_CLOSE)
        held.detach()
    one.close(linger=0)


def is_well(served):
    assert served.process.poll() is None
    assert served.anna.send(Status(), timeout_s=20.0).accepted


@pytest.mark.parametrize("kind", [zmq.DEALER, zmq.SUB], ids=["commands", "telemetry"])
def test_pings_in_a_flood_that_ends_in_a_reset_end_nothing_else(served, kind):
    """libzmq 4.3.5: a ping that waits behind a full queue when its connection breaks is an assertion."""
    for number in range(40):
        flood_and_reset(kind, served.key(f"mallory-{kind}-{number}"))
        assert served.process.poll() is None

    is_well(served)


def test_a_message_of_endlessly_many_parts_ends_its_connection_alone(served):
    gateway, key = psutil.Process(served.process.pid), served.key("endless")
    before, most = gateway.memory_info().rss, 0
    one, descriptor = keyed(zmq.DEALER, key, key.command_port)
    held = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    port = held.getsockname()[1]
    held.detach()
    one.send_multipart(
        30_000 * [b"x" * 4000]
    )  # ZeroMQ sends no message before its last part is there

    def ended():
        nonlocal most
        most = max(most, gateway.memory_info().rss)
        connections = gateway.net_connections("tcp")
        return not any(
            c.status == "ESTABLISHED" and c.raddr and c.raddr.port == port for c in connections
        )

    until(ended)
    one.close(linger=0)

    assert most - before < 60 * 2**20
    is_well(served)


def test_who_is_ended_for_a_flood_is_refused_for_a_while_and_others_are_not(served):
    key = served.key("flooder")
    one, _ = keyed(zmq.DEALER, key, key.command_port)

    def refused():
        with suppress(zmq.Again):
            for _ in range(1000):
                one.send_multipart([b"tag", b"garbage"], zmq.NOBLOCK)
        return any("the key flooder sends far more" in told for told in served.events())

    until(refused)
    one.close(linger=0)
    with pytest.raises(ConnectionError):
        served.client_of(key).send(Status(), timeout_s=1.0)
    is_well(served)


def test_who_connects_anew_with_each_flood_of_stops_is_refused_for_a_while_and_others_are_not(
    served,
):
    """Each connection stays below its limit, and hangs up; a commander's stops exceed the rate of commands."""
    key, stop = served.key("stopper"), msgspec.msgpack.encode(Stop())
    given = [
        tcp_endpoint(key.host, key.command_port).encode(),
        key.server_public.encode(),
        key.public.encode(),
        key.secret.encode(),
        stop,
    ]
    # A process of its own: here, each message would wait for the thread that steps the instrument.
    flood = subprocess.Popen([sys.executable, "-c", FLOODS, *(one.hex() for one in given)])

    until(lambda: any("the key stopper sends far more" in told for told in served.events()))
    flood.terminate()
    flood.wait(20)
    is_well(served)


def test_a_key_that_connects_too_often_waits_and_then_comes_in(served):
    key = served.key("hasty")
    many = [served.client_of(key) for _ in range(35)]  # two connections each, with the telemetry

    assert all(client.send(Status(), timeout_s=20.0).accepted for client in many)
    is_well(served)


def test_1500_silent_strangers_keep_nobody_out(served):
    few, many = resource.getrlimit(resource.RLIMIT_NOFILE)
    if many < 4000:
        pytest.skip(f"only {many} open files are allowed here, 4000 are needed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(few, 4000), many))
    service = served.rig.service
    strangers = [
        socket.create_connection(("127.0.0.1", port), 20.0)
        for port in 750 * [service.command_port, service.telemetry_port]
    ]
    try:
        is_well(served)
        assert served.person("newcomer").send(Status(), timeout_s=20.0).accepted
    finally:
        for stranger in strangers:
            stranger.close()
    is_well(served)
