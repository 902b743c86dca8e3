"""The service, reached by anything at all: it stays well, and what is a command is still obeyed."""

import time

import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instruments.served import Served

from fitctl.messages.commands import Status, Stop
from fitctl.messages.endpoints import COMMAND_SOCKET, TELEMETRY_SOCKET, tcp_endpoint

FRAMES = st.lists(st.binary(max_size=64) | st.just(b"x" * 5000), min_size=1, max_size=6)
KINDS = st.sampled_from([zmq.DEALER, zmq.REQ, zmq.PUB, zmq.SUB])


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    served = Served(tmp_path_factory.mktemp("garbage"), "service.commands_per_s=1000.0", tcp=True)
    served.start()
    yield served
    served.close()


@pytest.mark.long
@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(messages=st.lists(FRAMES, max_size=8), kind=KINDS, which=st.integers(0, 3))
def test_any_messages_from_any_kind_of_socket_leave_it_well(served, messages, kind, which):
    service = served.rig.service
    doors = [
        f"ipc://{served.folder / COMMAND_SOCKET}",
        f"ipc://{served.folder / TELEMETRY_SOCKET}",
        tcp_endpoint("127.0.0.1", service.command_port),
        tcp_endpoint("127.0.0.1", service.telemetry_port),
    ]
    with zmq.Context() as context, context.socket(kind) as stranger:
        stranger.setsockopt(zmq.LINGER, 20)
        stranger.setsockopt(zmq.SNDTIMEO, 20)
        if kind == zmq.SUB:
            stranger.setsockopt(zmq.SUBSCRIBE, b"")
        stranger.connect(doors[which])
        try:
            for frames in messages:
                stranger.send_multipart(frames)
        except zmq.ZMQError:
            pass  # this kind cannot send, or not so often

    assert served.client.send(Status()).accepted


@settings(max_examples=40)
@given(streams=st.lists(st.binary(max_size=200), max_size=5), keyed=st.booleans())
def test_any_bytes_on_the_wire_leave_it_well(served, streams, keyed):
    service = served.rig.service
    port = service.command_port if keyed else service.telemetry_port
    with zmq.Context() as context, context.socket(zmq.STREAM) as stranger:
        stranger.setsockopt(zmq.LINGER, 20)
        stranger.setsockopt(zmq.SNDTIMEO, 20)
        stranger.connect(tcp_endpoint("127.0.0.1", port))
        if stranger.poll(1000):
            peer, _ = stranger.recv_multipart()
            try:
                for stream in streams:
                    stranger.send_multipart([peer, stream])
            except zmq.ZMQError:
                pass  # it has hung up

    assert served.client.send(Status()).accepted


def test_a_flood_of_commands_is_held_back_and_a_stop_comes_through(served, monkeypatch):
    """More than it takes: what is too much waits with its sender, and hinders nobody else."""
    door, received = served.service._local, []
    receive = door.receive
    monkeypatch.setattr(
        door, "receive", lambda messages: received.append(receive(messages)) or received[-1]
    )
    begun_s = time.monotonic()
    with zmq.Context() as context, context.socket(zmq.DEALER) as flood:
        flood.setsockopt(zmq.LINGER, 0)
        flood.setsockopt(zmq.SNDHWM, 1000)
        flood.connect(f"ipc://{served.folder / COMMAND_SOCKET}")
        sent = 0
        while flood.poll(50, zmq.POLLOUT) and sent < 5000:
            flood.send_multipart([b"tag", b"garbage"])
            sent += 1

        assert served.client.send(Stop()).accepted
        assert served.client.send(Status()).text == "right SAFE"
    lasted_s = time.monotonic() - begun_s
    assert sum(map(len, received)) <= 8 * (lasted_s / 0.005 + 2)
    assert sum("no commands" in told for told in served.events()) <= 10
