"""One flood of :mod:`benchmarks.flood`: KIND SOCKETS KEY_FILE RATE_HZ DURATION_S."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import zmq

from fitctl.messages.commands import SetTarget
from fitctl.messages.endpoints import COMMAND_SOCKET, tcp_endpoint
from fitctl.messages.keys import read_remote

BURST_S = 0.005
LARGEST_BURST = 200
COMMAND = msgspec.msgpack.encode(SetTarget(az_px=21.0, el_px=19.0))


def flood(kind: str, sockets: Path, key_file: Path, rate_hz: float, duration_s: float) -> None:
    """Offer messages at a pace; print how many were offered, and how many could be sent."""
    context = zmq.Context()
    send = senders(kind, context, sockets, key_file)
    offered = sent = 0
    print("begun", flush=True)
    begun_s = time.monotonic()
    while (gone_s := time.monotonic() - begun_s) < duration_s:
        for _ in range(min(round(gone_s * rate_hz) - offered, LARGEST_BURST)):
            sent += next(send)
            offered += 1
        time.sleep(BURST_S)
    print(json.dumps([offered, sent]))
    context.destroy(linger=0)


def senders(kind: str, context: zmq.Context, sockets: Path, key_file: Path) -> Iterator[bool]:
    """Each step sends one message; whether it could."""
    if kind == "stranger":
        yield from strangers(context, key_file)
    dealer = context.socket(zmq.DEALER)
    dealer.setsockopt(zmq.SNDHWM, 1000)
    sink = context.socket(zmq.ROUTER)
    if kind == "elsewhere":
        sink.setsockopt(zmq.RCVHWM, 64)  # as the service's, and never read
        dealer.connect(f"tcp://127.0.0.1:{sink.bind_to_random_port('tcp://127.0.0.1')}")
    elif kind == "key":
        keyed(dealer, key_file)
        dealer.connect(command_port(key_file))
    else:
        dealer.connect(f"ipc://{sockets / COMMAND_SOCKET}")
    payload = b"\xc1" * 64 if kind == "garbage" else COMMAND
    while True:
        try:
            dealer.send_multipart([b"tag", payload], zmq.NOBLOCK)
            while dealer.getsockopt(zmq.EVENTS) & zmq.POLLIN:
                dealer.recv_multipart(zmq.NOBLOCK)
            yield True
        except zmq.Again:
            yield False


def strangers(context: zmq.Context, key_file: Path) -> Iterator[bool]:
    """Each step connects with a key that nobody knows, and lets go of an older connection."""
    knocking: list[zmq.Socket] = []
    public, secret = zmq.curve_keypair()
    while True:
        if len(knocking) > 100:
            knocking.pop(0).close(linger=0)
        try:
            stranger = context.socket(zmq.DEALER)
        except zmq.ZMQError:  # closing takes longer than opening
            yield False
            continue
        keyed(stranger, key_file)
        stranger.curve_publickey, stranger.curve_secretkey = public, secret
        stranger.connect(command_port(key_file))
        knocking.append(stranger)
        yield True


def keyed(socket: zmq.Socket, key_file: Path) -> None:
    """Give a socket the key of a file."""
    key = read_remote(key_file)
    socket.curve_serverkey = key.server_public.encode()
    socket.curve_publickey = key.public.encode()
    socket.curve_secretkey = key.secret.encode()


def command_port(key_file: Path) -> str:
    """Where the key of a file sends commands."""
    key = read_remote(key_file)
    return tcp_endpoint(key.host, key.command_port)


if __name__ == "__main__":
    what, sockets, key, rate, duration = sys.argv[1:]
    flood(what, Path(sockets), Path(key), float(rate), float(duration))
