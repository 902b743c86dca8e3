"""A rig from another machine: who gets in, what they may do, and how they are put out again."""

import stat
from contextlib import suppress

import msgspec
import pytest
import zmq
from instruments.served import Served, until

from fitctl.clock import MonotonicClock
from fitctl.config import ConfigError
from fitctl.messages.client import Client
from fitctl.messages.commands import Release, Standby, Status, Stop, TakeOver
from fitctl.messages.endpoints import tcp_endpoint
from fitctl.messages.keys import revoke_key
from fitctl.sequences.instrument import Instrument
from fitctl.service.gateway import Gateway
from fitctl.service.keyed_door import check_keyed_door


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    served = Served(tmp_path_factory.mktemp("remote"), tcp=True)
    served.start()
    yield served
    served.close()


@pytest.fixture(autouse=True)
def free(request):
    """Nobody has the instrument when a test begins."""
    if "served" in request.fixturenames:
        request.getfixturevalue("served").service._admission._holder = ""


def test_a_commander_elsewhere_commands_and_sees_what_the_owner_sees(served):
    anna = served.person("anna")

    reply = anna.send(Standby(), timeout_s=20.0)  # imports much, once
    assert reply.accepted, reply.text

    telemetry = served.follow(lambda t: t.commander == "anna", client=anna)
    assert telemetry.rig_name == "fit-mock"
    assert served.follow(lambda t: t.sequence > telemetry.sequence).commander == "anna"
    until(lambda: ("anna", True) in served.commands("Standby"))


def test_a_viewer_sees_everything_and_commands_nothing(served):
    viewer = served.person("viewer", "viewer")

    assert served.follow(lambda t: t.loops, client=viewer)
    assert viewer.send(Status()).accepted
    for command in (Stop(), Standby(), TakeOver()):
        reply = viewer.send(command)
        assert not reply.accepted
        assert "can watch but not command" in reply.text
    until(lambda: ("viewer", False) in served.commands("Stop"))


def test_stop_is_taken_from_whoever_may_command(served):
    holder, other = served.person("holder"), served.person("other")
    holder.send(TakeOver())

    assert "holder has the instrument" in other.send(Release()).text
    assert other.send(Stop()).accepted
    assert served.client.send(Stop()).accepted
    assert served.follow(lambda t: t.loops[0].mode == "SAFE").commander == "holder"


def test_taking_over_is_told_to_everybody(served):
    first, second = served.person("first"), served.person("second")
    first.send(TakeOver())

    assert second.send(TakeOver()).text == "second has the instrument, taken over from first"

    assert served.follow(lambda t: t.commander == "second")
    until(lambda: "second has the instrument, taken over from first" in served.events())
    assert not first.send(Release()).accepted


def test_revoking_refuses_commands_and_cuts_telemetry_of_who_is_connected(served):
    bad, good = served.person("bad"), served.person("good")
    bad.send(TakeOver())
    served.follow(lambda t: True, client=bad)
    served.follow(lambda t: True, client=good)

    revoke_key(served.rig, "bad")
    until(lambda: "the key bad was revoked or changed" in served.events())

    assert bad.send(Stop()).text == "this key has been revoked"  # by the connection that it had
    while bad.receive(0.0) is not None:
        pass  # what had come before
    assert served.follow(lambda t: t.commander == "", client=good)
    assert bad.receive(1.0) is None
    assert "bad" not in [name for name, _ in served.commands("Stop")]


def test_a_key_that_is_unknown_is_told_that_it_is(served):
    key = served.key("stranger")
    revoke_key(served.rig, "stranger")
    until(lambda: not any(k.name == "stranger" for k in served.gateway._keyed.allowed.values()))

    stranger = served.client_of(key)
    with pytest.raises(ConnectionError, match="does not let the key stranger in"):
        stranger.send(Status(), timeout_s=0.5)
    assert stranger.receive(0.2) is None


def test_a_key_to_another_server_is_told_so(served):
    key = served.key("lost")
    wrong = msgspec.structs.replace(key, server_public=key.public)

    with pytest.raises(ConnectionError, match="the server given a new key"):
        served.client_of(wrong).send(Status(), timeout_s=0.5)


def test_where_nobody_listens_a_client_says_what_to_look_at(served):
    key = msgspec.structs.replace(served.key("far"), command_port=1)

    with pytest.raises(ConnectionError, match=r"no supervisor answers at 127\.0\.0\.1 port 1 "):
        served.client_of(key).send(Status(), timeout_s=0.2)


def bare(_one):
    """No security at all."""


def with_a_password(one):
    one.plain_username, one.plain_password = b"anna", b"anna"


def with_an_unknown_pair(one):
    one.curve_publickey, one.curve_secretkey = zmq.curve_keypair()
    one.curve_serverkey = zmq.curve_keypair()[0]


@pytest.mark.parametrize("secured", [bare, with_a_password, with_an_unknown_pair])
def test_without_a_key_there_is_neither_answer_nor_telemetry(served, secured):
    service = served.rig.service
    with zmq.Context() as context:
        dealer, subscriber = context.socket(zmq.DEALER), context.socket(zmq.SUB)
        for stranger, port in (
            (dealer, service.command_port),
            (subscriber, service.telemetry_port),
        ):
            secured(stranger)
            stranger.setsockopt(zmq.LINGER, 0)
            stranger.connect(tcp_endpoint("127.0.0.1", port))
        subscriber.subscribe(b"")
        with suppress(
            zmq.Again
        ):  # the door may have ended the handshake already: no way out is left
            dealer.send_multipart([b"tag", msgspec.msgpack.encode(Stop())], zmq.NOBLOCK)

        assert not dealer.poll(700)
        assert not subscriber.poll(100)
        dealer.close()
        subscriber.close()


def test_a_key_whose_file_others_can_read_lets_nobody_in(served):
    open_client = served.person("open")
    path = served.keys / "keys" / "allowed" / "open.toml"
    assert open_client.send(Status()).accepted

    path.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IROTH)
    until(lambda: any("open.toml" in told for told in served.events()))

    assert open_client.send(Status()).text == "this key has been revoked"
    path.unlink()


def test_the_clock_of_another_machine_is_learned(served):
    anna = served.person("clock")
    anna.send(Status())
    assert abs(anna.now_s() - served.client.now_s()) < 1.0

    anna._hear(anna.now_s() + 1e6)

    assert anna.now_s() > 5e5


def test_a_python_program_elsewhere_has_the_instrument(served):
    served.key("python")

    with Instrument(served.rig, remote=served.keys / "python.key.toml") as instrument:
        assert instrument.telemetry().rig_name == "fit-mock"
        assert instrument.send(TakeOver()).accepted


@pytest.mark.long
def test_ports_that_are_taken_are_named(served):
    with pytest.raises(ConfigError, match=r"service\.tcp_address.*choose others"):
        Gateway(served.rig, served.folder, MonotonicClock())
    with pytest.raises(ConfigError, match=r"service\.tcp_address.*choose others"):
        check_keyed_door(served.rig)


def test_a_client_that_is_closed_lets_go_of_everything(served):
    client = Client(served.key("short"))
    client.send(Status())

    client.close()

    assert not client._idle
