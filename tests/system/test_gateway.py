"""A real supervisor that is reached by TCP: the network is its gateway's, and so are the network's troubles."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress

import psutil
import pytest
import zmq
from instruments.served import free_port

from fitctl.config import load_rig
from fitctl.messages.client import Client
from fitctl.messages.commands import Status, TakeOver
from fitctl.messages.endpoints import tcp_endpoint
from fitctl.messages.keys import new_key
from fitctl.processes import rig_arguments

from .conftest import START_S, Rig, absent_devices

_HEARTBEAT_MS = 2
_ROUNDS = 40


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """One without devices, in OFF, with keys for anna and bob, and a client of anna's."""
    folder = tmp_path_factory.mktemp("gateway")
    rig = Rig(folder)
    rig.endpoints = absent_devices()
    rig.settings += [
        "interlocks.disk_space.low=0.0",
        "service.tcp_address=127.0.0.1",
        f"service.keys_folder={folder / 'keys'}",
        f"service.command_port={free_port()}",
        f"service.telemetry_port={free_port()}",
    ]
    loaded = load_rig(rig.file, rig.settings)
    rig.key, rig.other_key = (
        new_key(loaded, name, "commander", "", folder / f"{name}.key.toml")
        for name in ("anna", "bob")
    )
    rig.start_supervisor()
    rig.anna = Client(rig.key)
    try:
        yield rig
    finally:
        rig.anna.close()
        rig.close()


def gateway_of(rig):
    """The gateway's process, once it listens."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        gateway = rig.child("gateway")
        with suppress(psutil.Error):  # it ends at this moment
            if listening(gateway):
                return gateway
        time.sleep(0.05)
    raise AssertionError(f"no gateway within {START_S} s")


def listening(process):
    return {c.laddr.port for c in process.net_connections("tcp") if c.status == "LISTEN"}


def answered(client):
    """A client is answered, sooner or later."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        with suppress(ConnectionError):
            return client.send(Status())
    raise AssertionError(f"no answer within {START_S} s")


def test_the_supervisor_has_no_socket_on_the_network_and_its_gateway_gives_way(rig):
    gateway = gateway_of(rig)
    assert answered(rig.anna).text == "right OFF"

    assert listening(gateway) == {rig.key.command_port, rig.key.telemetry_port}
    assert psutil.Process(rig.supervisor.pid).net_connections("inet") == []
    modest = min(19, os.getpriority(os.PRIO_PROCESS, rig.supervisor.pid) + 10)
    for thread in (thread.id for thread in gateway.threads()):
        assert os.getpriority(os.PRIO_PROCESS, thread) == modest
        assert os.sched_getscheduler(thread) == os.SCHED_OTHER


@pytest.mark.parametrize(
    ("by", "told"),
    [(signal.SIGKILL, "the gateway was killed by signal 9"), (signal.SIGALRM, "the gateway hung")],
    ids=["killed", "hung"],
)
def test_a_gateway_that_ends_is_told_of_and_clients_come_back_by_themselves(rig, by, told):
    assert answered(rig.anna).accepted
    before = gateway_of(rig)

    before.send_signal(by)

    rig.follow(lambda t: any(told in e.message for e in t.events))
    assert gateway_of(rig).pid != before.pid
    assert answered(rig.anna).text == "right OFF"
    while rig.anna.receive(0.0) is not None:
        pass
    assert rig.anna.receive(START_S).loops[0].mode == "OFF"
    assert rig.supervisor.poll() is None


@pytest.mark.parametrize("who", ["supervisor", "gateway"])
def test_a_command_that_was_reported_as_unanswered_is_not_carried_out_later(rig, who):
    assert commander_now(rig) != "anna"
    stood_still = psutil.Process(rig.supervisor.pid) if who == "supervisor" else gateway_of(rig)
    stood_still.suspend()
    try:
        with pytest.raises(ConnectionError, match="no supervisor answers"):
            rig.anna.send(TakeOver())
    finally:
        stood_still.resume()

    assert commander_now(rig) != "anna"
    assert rig.anna.send(TakeOver()).accepted
    assert commander_now(rig) == "anna"
    assert rig.client.send(TakeOver()).accepted


def commander_now(rig):
    """After all commands before this have been read."""
    reply_s = answered(rig.anna).time_s
    return rig.follow(lambda t: t.time_s >= reply_s)[-1].commander


def test_heartbeats_by_an_allowed_key_are_the_gateways_affair_alone(rig):
    """Whatever libzmq makes of them: a client that pings, does not read, and hangs up."""
    sequence = rig.follow(lambda _: True)[-1].sequence
    # In a process of its own: libzmq may abort the client for its own heartbeats, too.
    attack = multiprocessing.get_context("spawn").Process(
        target=ping_and_hang_up, args=[rig.other_key]
    )
    attack.start()
    attack.join(START_S)
    ended = attack.exitcode
    attack.kill()

    assert ended in {0, -signal.SIGABRT}

    assert rig.follow(lambda t: t.sequence > sequence)
    assert rig.supervisor.poll() is None
    assert answered(rig.anna).text == "right OFF"


def ping_and_hang_up(key):
    with zmq.Context() as context:
        for _ in range(_ROUNDS):
            some = [pinging(context, key) for _ in range(3)]
            time.sleep(0.02)
            for one in some:
                one.close(linger=0)


def pinging(context, key):
    dealer = context.socket(zmq.DEALER)
    dealer.curve_serverkey = key.server_public.encode()
    dealer.curve_publickey, dealer.curve_secretkey = key.public.encode(), key.secret.encode()
    dealer.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
    dealer.setsockopt(zmq.HEARTBEAT_TTL, 100)
    dealer.setsockopt(zmq.RCVHWM, 1)
    dealer.connect(tcp_endpoint(key.host, key.command_port))
    with suppress(zmq.Again):
        for _ in range(200):
            dealer.send_multipart([b"tag", b"garbage"], zmq.NOBLOCK)
    return dealer


def test_a_port_that_somebody_else_has_is_one_line_and_status_2(rig, tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        devices = [f"{key}={value}" for key, value in absent_devices().items()]
        changed = [f"service.command_port={port}", f"service.folder={tmp_path / 's'}", *devices]
        options = rig_arguments(rig.file, [*rig.settings, *changed])
        done = subprocess.run(
            [sys.executable, "-m", "fitctl", "run", *options],
            capture_output=True,
            text=True,
            timeout=START_S,
            check=False,
        )

    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith(f"service.tcp_address: 127.0.0.1, ports {port} and ")
    assert done.stderr.count("\n") == 1
