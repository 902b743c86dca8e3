"""The gateway between the network and the supervisor: what it passes on, for whom, and what only it may say."""

import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress

import msgspec
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from instruments.served import Served, rig_in, until

from fitctl.clock import MonotonicClock, VirtualClock
from fitctl.config import ConfigError
from fitctl.logging.records import CommandRecord
from fitctl.messages.client import Client
from fitctl.messages.commands import Release, Standby, Status, Stop, TakeOver
from fitctl.messages.endpoints import (
    GATEWAY_SOCKET,
    TELEMETRY_SOCKET,
    make_service_folder,
    tcp_endpoint,
)
from fitctl.messages.keys import AllowedKey, new_key, revoke_key
from fitctl.service.envelope import Passed, Report, decode_envelope
from fitctl.service.gateway import Gateway
from fitctl.service.keyed_door import check_keyed_door

STOP = msgspec.msgpack.encode(Stop())
OF_ANNA = Passed(name="anna", role="commander", address="10.0.0.1", payload=STOP)


@pytest.fixture
def served(tmp_path):
    served = Served(tmp_path, "service.commands_per_s=5.0", tcp=True)
    served.start()
    yield served
    served.close()


@pytest.fixture
def say(served):
    """Say something on the gateway's own socket."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 1000)
        dealer.connect(f"ipc://{served.folder / GATEWAY_SOCKET}")
        yield lambda payload: dealer.send_multipart([b"route", payload])


def test_an_envelope_is_no_command_on_the_socket_for_everybody(served):
    reply = served.raw(b"tag", msgspec.msgpack.encode(OF_ANNA))

    assert not reply.accepted
    assert "not a command" in reply.text
    assert served.client.send(Status()).text == "right OFF"
    assert served.commands("Stop") == []


def test_an_envelope_is_no_command_from_the_network(served):
    anna = served.person("anna")
    _, dealer = anna._dealer(5.0)
    dealer.send_multipart([b"tag", msgspec.msgpack.encode(OF_ANNA)])

    assert dealer.poll(5000)
    reply = msgspec.msgpack.decode(dealer.recv_multipart()[1])
    dealer.close()
    assert not reply["accepted"]
    assert "not a command" in reply["text"]


def test_on_its_own_socket_the_gateway_speaks_for_a_key(served, say):
    say(msgspec.msgpack.encode(OF_ANNA))

    until(lambda: served.commands("Stop") == [("anna", True)])


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x81\xa1x" + 2000 * b"\x91",  # nested deeply
        STOP,
        msgspec.msgpack.encode(msgspec.structs.replace(OF_ANNA, name="root@here")),
        msgspec.msgpack.encode(msgspec.structs.replace(OF_ANNA, role="owner")),
        msgspec.msgpack.encode(msgspec.to_builtins(OF_ANNA) | {"is_local": True}),
    ],
)
def test_the_gateway_speaks_for_nobody_of_this_machine_and_in_envelopes_alone(payload):
    assert decode_envelope(payload) is None


@given(st.binary(max_size=200))
def test_any_bytes_are_an_envelope_or_none(payload):
    assert isinstance(decode_envelope(payload), Passed | Report | None)


def test_what_is_no_envelope_is_counted(served, say):
    for _ in range(3):
        say(b"garbage")

    until(lambda: any("gateway: " in told and "no envelopes" in told for told in served.events()))
    assert served.client.send(Status()).accepted


def test_telemetry_is_passed_on_as_it_is(served):
    key = served.key("anna")
    service = served.rig.service
    with zmq.Context() as context:
        near, far = context.socket(zmq.SUB), context.socket(zmq.SUB)
        far.curve_serverkey = key.server_public.encode()
        far.curve_publickey, far.curve_secretkey = key.public.encode(), key.secret.encode()
        for subscriber in (near, far):
            subscriber.subscribe(b"")
            subscriber.rcvtimeo = 20_000
        near.connect(f"ipc://{served.folder / TELEMETRY_SOCKET}")
        heard = [near.recv()]  # all that the other may hear
        far.connect(tcp_endpoint("127.0.0.1", service.telemetry_port))
        passed = far.recv()
        until(lambda: passed in heard or heard.append(near.recv()))
        near.close(linger=0)
        far.close(linger=0)


def test_who_sends_too_much_is_turned_back_before_the_supervisor_but_for_stops(served, monkeypatch):
    served.stop_gateway()
    served.start_gateway(VirtualClock())
    reached, accept = [], served.service._intake.accept
    monkeypatch.setattr(
        served.service._intake,
        "accept",
        lambda name, *rest: reached.append(name) or accept(name, *rest),
    )
    anna = served.person("anna")

    replies = [anna.send(Status()) for _ in range(20)]
    assert [reply.accepted for reply in replies] == [True] * 5 + [False] * 15
    assert all("more than 5 commands a second" in reply.text for reply in replies[5:])
    assert reached == ["anna"] * 5

    assert all(anna.send(Stop()).accepted for _ in range(20))
    assert served.simulation.supervisor.loops["right"].mode.name == "SAFE"
    served.gateway._clock.sleep_until(10.0)
    until(lambda: "anna: 15 messages, over the rate limit" in served.events())


def test_clients_come_back_to_a_new_gateway_and_a_key_revoked_meanwhile_does_not(served):
    anna, bob = served.person("anna"), served.person("bob")
    assert anna.send(TakeOver()).accepted
    assert bob.send(Status()).accepted
    served.follow(lambda t: t.commander == "anna", client=bob)

    served.stop_gateway()
    revoke_key(served.rig, "anna")
    served.start_gateway()

    assert served.follow(lambda t: t.commander == "", client=bob)
    assert bob.send(Release()).text  # from the supervisor: there is nothing to hold
    assert "the key anna was revoked or changed" in served.events()
    with pytest.raises(ConnectionError, match="does not let the key anna in"):
        anna.send(Stop(), timeout_s=0.5)


def test_a_report_of_keys_takes_the_instrument_from_nobody_else(served, say):
    anna = AllowedKey(name="anna", role="commander", public="x" * 40)
    assert served.client.send(TakeOver()).accepted
    say(msgspec.msgpack.encode(Report(keys=[anna], events=[("info", "one key")])))
    say(msgspec.msgpack.encode(Report(keys=[], events=[])))

    until(lambda: "the key anna was revoked or changed" in served.events())
    assert "one key" in served.events()
    assert served.follow(lambda t: "@" in t.commander)


def test_a_client_elsewhere_sends_by_the_supervisors_clock_from_its_first_command_on(tmp_path):
    clock = VirtualClock()
    served = Served(tmp_path, tcp=True, clock=clock)
    served.start()
    clock.sleep_until(5000.0)
    try:
        anna = served.person("anna")
        first = anna.send(TakeOver())
        clock.sleep_until(5004.0)
        late, again = anna.send(TakeOver()), anna.send(TakeOver())
    finally:
        served.close()

    assert first.accepted, first.text
    # Its own clock has stood still for 4 s; by the answer it knows.
    assert "TakeOver was sent 4.0 s ago" in late.text
    assert again.accepted, again.text


class Network(threading.Thread):
    """A connection to a port of this machine, which can hold back what is sent."""

    def __init__(self, to_port):
        super().__init__(daemon=True)
        self._to_port = to_port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.passes = threading.Event()
        self.passes.set()

    def run(self):
        near, _ = self._listening.accept()
        far = socket.create_connection(("127.0.0.1", self._to_port))
        for ends in ((near, far), (far, near)):
            threading.Thread(target=self._pass_on, args=ends, daemon=True).start()

    def _pass_on(self, source, target):
        with suppress(OSError):
            while some := source.recv(65536):
                self.passes.wait()
                target.sendall(some)

    def close(self):
        self.passes.set()
        self._listening.close()


def test_a_command_that_the_network_held_back_is_not_carried_out_after_its_sender_gave_up(served):
    key = served.key("anna")
    network = Network(key.command_port)
    network.start()
    anna = served.client_of(msgspec.structs.replace(key, command_port=network.port))
    assert anna.send(TakeOver(), timeout_s=20.0).accepted
    network.passes.clear()
    with pytest.raises(ConnectionError):
        anna.send(Standby())

    network.passes.set()

    until(lambda: served.commands("Standby"))
    network.close()
    assert served.commands("Standby") == [("anna", False)]
    assert served.simulation.supervisor.loops["right"].mode.name == "OFF"


def test_who_sends_to_a_gateway_without_a_supervisor_is_answered(gateway_in, tmp_path):
    anna = Client(new_key(gateway_in, "anna", "commander", "", tmp_path / "anna.key.toml"))
    try:
        reply = anna.send(Status(), timeout_s=20.0)
    finally:
        anna.close()

    assert not reply.accepted
    assert reply.text == "the supervisor accepts no commands at the moment; try again"


HANGING = """
import sys, time
from fitctl.cli import main
from fitctl.service import gateway, keyed_door

gateway._HUNG_S = 2
keyed_door.KeyedDoor.admit = lambda *_: time.sleep(600)
main(sys.argv[1:])
"""


@pytest.mark.long
def test_a_gateway_that_hangs_is_ended_by_its_alarm(tmp_path):
    rig = rig_in(tmp_path, "service.tcp_address=127.0.0.1")
    make_service_folder(rig)
    new_key(rig, "anna", "commander", "", tmp_path / "anna.key.toml")
    settings = ("tcp_address", "folder", "keys_folder", "command_port", "telemetry_port")
    given = [f"--set=service.{name}={getattr(rig.service, name)}" for name in settings]

    done = subprocess.run(
        [sys.executable, "-c", HANGING, "gateway", *given],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert done.returncode == -signal.SIGALRM
    assert not done.stderr


@pytest.fixture
def gateway_in(tmp_path):
    """A rig with a gateway, and no supervisor."""
    rig = rig_in(tmp_path, "service.tcp_address=127.0.0.1")
    make_service_folder(rig)
    gateway, ending = Gateway(rig, tmp_path / "s", MonotonicClock()), threading.Event()
    thread = threading.Thread(target=gateway.run, args=[ending])
    thread.start()
    yield rig
    ending.set()
    thread.join()


def heard_in(folder, timeout_ms):
    """What a gateway says to whoever has its socket in a folder."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as supervisor:
        supervisor.setsockopt(zmq.LINGER, 0)
        supervisor.bind(f"ipc://{folder / GATEWAY_SOCKET}")
        if not supervisor.poll(timeout_ms):
            return None
        return decode_envelope(supervisor.recv_multipart()[-1])


def test_a_gateway_connects_again_only_in_a_folder_that_nobody_else_could_have_made(
    gateway_in, tmp_path
):
    rig, folder = gateway_in, tmp_path / "s"
    assert "listening at" in heard_in(folder, 20_000).events[0][1]
    folder.rename(tmp_path / "away")
    folder.mkdir()
    folder.chmod(0o777)
    new_key(rig, "anna", "commander", "", tmp_path / "anna.key.toml")  # there is something to say

    assert heard_in(folder, 1500) is None
    folder.chmod(0o700)
    report = heard_in(folder, 20_000)

    assert [key.name for key in report.keys] == ["anna"]
    assert any("is not safe" in text for _, text in report.events)


# ---------------------------------------------------------------- ports


def test_a_port_that_is_about_to_be_free_is_waited_for(tmp_path):
    rig = rig_in(tmp_path, "service.tcp_address=127.0.0.1")
    with socket.socket() as before_us:
        before_us.bind(("127.0.0.1", rig.service.telemetry_port))
        before_us.listen()
        threading.Timer(0.2, before_us.close).start()

        check_keyed_door(rig)


@pytest.mark.parametrize("address", ["192.0.2.1", "2001:db8::1"])
def test_an_address_that_is_not_ours_is_named(tmp_path, address):
    rig = rig_in(tmp_path, f"service.tcp_address={address}")

    with pytest.raises(
        ConfigError, match=rf"service\.tcp_address: {address}, ports .*choose others"
    ):
        check_keyed_door(rig)


def test_without_an_address_there_are_neither_ports_nor_keys(tmp_path):
    check_keyed_door(rig_in(tmp_path))

    assert not (tmp_path / "keys").exists()


# ---------------------------------------------------------------- floods by an allowed key


@pytest.mark.parametrize("loop", ["", "right", "x" * 3900], ids=["all", "one", "nonsense"])
def test_a_viewers_flood_of_stops_costs_the_log_a_few_short_records(served, loop):
    sent, key = 2000, served.key("viewer", "viewer")
    begun_s = time.monotonic()
    with keyed_dealer(key) as dealer:
        for _ in range(sent):
            dealer.send_multipart([b"tag", msgspec.msgpack.encode(Stop(loop=loop))])
        until(lambda: counted(served, "viewer: ", "over the rate limit") >= 100)
    lasted_s = time.monotonic() - begun_s

    of_viewer = [
        record
        for record in served.records
        if isinstance(record, CommandRecord) and record.sender == "viewer"
    ]
    assert 1 <= len(of_viewer) <= 10 + lasted_s
    assert max(len(msgspec.msgpack.encode(record)) for record in of_viewer) < 600
    assert len([told for told in served.events() if "viewer: " in told]) <= 4 * (1 + lasted_s / 5)
    assert served.simulation.supervisor.loops["right"].mode.name == "OFF"
    assert served.person("anna").send(Stop()).accepted


def keyed_dealer(key):
    """A client that sends as fast as it can."""
    dealer = zmq.Context.instance().socket(zmq.DEALER)
    dealer.curve_serverkey = key.server_public.encode()
    dealer.curve_publickey, dealer.curve_secretkey = key.public.encode(), key.secret.encode()
    dealer.setsockopt(zmq.LINGER, 0)
    dealer.setsockopt(zmq.SNDTIMEO, 20_000)
    dealer.connect(tcp_endpoint(key.host, key.command_port))
    return dealer


def counted(served, whose, why):
    """How many messages the events say were rejected."""
    lines = [told for told in served.events() if told.startswith(whose) and told.endswith(why)]
    return sum(int(line.removeprefix(whose).split(" ")[0]) for line in lines)
