"""A simulated instrument behind a real service, and ways to speak to it that no client of ours has."""

import os
import socket
import threading
import time

import msgspec
import zmq

from fitctl.clock import MonotonicClock
from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import CommandRecord, Event
from fitctl.messages.client import Client
from fitctl.messages.commands import Reply
from fitctl.messages.endpoints import COMMAND_SOCKET, make_service_folder
from fitctl.messages.keys import new_key
from fitctl.service.gateway import Gateway
from fitctl.service.service import Service
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation

_GIVEN = set()


def free_port():
    """A free TCP port, and never one that an earlier call returned: the kernel may offer it again."""
    while True:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        if port not in _GIVEN:
            _GIVEN.add(port)
            return port


def rig_in(folder, *settings):
    """The default rig with its sockets and keys in a folder, and two TCP ports of its own."""
    return load_rig(
        default_rig_path(),
        [
            f"service.folder={folder / 's'}",
            f"service.keys_folder={folder / 'keys'}",
            f"service.command_port={free_port()}",
            f"service.telemetry_port={free_port()}",
            *settings,
        ],
    )


class Served:
    """Stepped by a thread; with `tcp` it has keys too, and a gateway on a thread."""

    def __init__(self, folder, *settings, tcp=False, clock=None):
        tcp_settings = ["service.tcp_address=127.0.0.1"] if tcp else []
        self.rig = rig_in(folder, *tcp_settings, *settings)
        self.keys = folder
        self.folder = make_service_folder(self.rig)
        self.buffer = TelemetryBuffer()
        self.records = []
        self.simulation = Simulation(self.rig, 0, star_offset_px=(9.0, 4.0), record=self.record)
        post = self.simulation.supervisor.post
        # The simulation has a time of its own, by which nothing waits for long.
        self.simulation.supervisor.post = lambda command, *rest: post(
            msgspec.structs.replace(command, sent_s=msgspec.UNSET), *rest
        )
        state = ServiceState(
            pid=os.getpid(),
            wall_minus_monotonic_s=0.0,
            scheduling="",
            records_lost=lambda: 7,
            records_offered=lambda: 1000,
        )
        self.service = Service(
            self.simulation.supervisor, self.buffer, self.folder, state, clock or MonotonicClock()
        )
        self.tcp = tcp
        self.ending = threading.Event()
        self.stepper = threading.Thread(target=self.step)
        self.clients = []
        self.client = self.client_of(self.folder)

    def start(self):
        # The first steps load what is compiled, which takes longer than a client waits on a busy machine.
        for _ in range(3):
            self.simulation.supervisor.step()
        self.service.start()
        self.stepper.start()
        if self.tcp:
            self.start_gateway()

    def start_gateway(self, clock=None):
        self.gateway_ending = threading.Event()
        self.gateway = Gateway(self.rig, self.folder, clock or MonotonicClock())
        self.gateway_thread = threading.Thread(target=self.gateway.run, args=[self.gateway_ending])
        self.gateway_thread.start()

    def stop_gateway(self):
        self.gateway_ending.set()
        self.gateway_thread.join()

    def record(self, record):
        self.buffer.add(record)
        if isinstance(record, CommandRecord | Event):
            self.records.append(record)

    def step(self):
        while not self.ending.wait(0.002):
            self.simulation.supervisor.step()

    def close(self):
        for client in self.clients:
            client.close()
        if self.tcp:
            self.stop_gateway()
        self.ending.set()
        if self.stepper.is_alive():
            self.stepper.join()
        self.service.stop()

    def client_of(self, where):
        self.clients.append(Client(where))
        return self.clients[-1]

    def key(self, name, role="commander"):
        return new_key(self.rig, name, role, "", self.keys / f"{name}.key.toml")

    def person(self, name, role="commander"):
        """A client with a key of its own."""
        return self.client_of(self.key(name, role))

    def commands(self, command):
        """Who gave a command, and whether it was accepted."""
        return [
            (record.sender, record.accepted)
            for record in self.records
            if isinstance(record, CommandRecord) and record.command == command
        ]

    def events(self):
        return [record.message for record in self.records if isinstance(record, Event)]

    def follow(self, reached, limit_s=20.0, client=None):
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s:
            telemetry = (client or self.client).receive(0.5)
            if telemetry is not None and reached(telemetry):
                return telemetry
        raise AssertionError("not reached")

    def raw(self, *parts):
        """Send what no client of ours would; returns the reply, or None."""
        context = zmq.Context()
        try:
            with context.socket(zmq.DEALER) as dealer:
                dealer.setsockopt(zmq.LINGER, 0)
                dealer.connect(f"ipc://{self.folder / COMMAND_SOCKET}")
                dealer.send_multipart(parts)
                if not dealer.poll(500):
                    return None
                return msgspec.msgpack.decode(dealer.recv_multipart()[1], type=Reply)
        finally:
            context.term()


def until(happened, limit_s=20.0):
    """Wait for something that another thread does."""
    end_s = time.monotonic() + limit_s
    while not happened():
        assert time.monotonic() < end_s, "it did not happen"
        time.sleep(0.01)
