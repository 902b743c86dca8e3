"""When a supervisor has ended after `shutdown`: on this machine, and on another."""

import socket
from types import SimpleNamespace

import pytest
from instruments.served import free_port

from fitctl.messages import waiting
from fitctl.messages.client import Client
from fitctl.messages.keys import RemoteKey
from fitctl.messages.waiting import wait_for_end


class Elsewhere:
    """A client of a supervisor on another machine; each message is a process number, or None for silence."""

    folder = None

    def __init__(self, *heard, listens=(), now_s=None):
        self._heard, self._listens, self._now_s = list(heard), list(listens), now_s

    def receive(self, timeout_s):
        self._now_s[0] += timeout_s
        pid = self._heard.pop(0)
        return None if pid is None else SimpleNamespace(pid=pid)

    def nobody_listens(self):
        return not self._listens.pop(0)

    def why_silent(self, timeout_s):
        return f"no answer within {timeout_s:g} s"


@pytest.fixture
def elsewhere(monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(waiting.time, "monotonic", lambda: now_s[0])
    return lambda *heard, listens=(): Elsewhere(*heard, listens=listens, now_s=now_s)


def test_a_pause_in_the_telemetry_from_elsewhere_is_no_end(elsewhere):
    client = elsewhere(7, None, 7, None, listens=[True, False])

    assert wait_for_end(client, 10.0)
    assert client._heard == []


def test_another_supervisor_in_its_place_is_its_end(elsewhere):
    assert wait_for_end(elsewhere(7, 7, 8), 10.0)


def test_one_that_goes_on_has_not_ended(elsewhere):
    assert not wait_for_end(elsewhere(7, 7), 0.9)


def test_of_a_machine_that_does_not_answer_nothing_is_known(elsewhere):
    with pytest.raises(ConnectionError, match=r"ended is not known: no answer within 0\.9 s"):
        wait_for_end(elsewhere(7, None, listens=[True]), 0.9)


def test_a_client_knows_whether_somebody_listens_where_its_key_leads(tmp_path):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        key = key_to(listening.getsockname()[1])
        assert not nobody_listens(key)
        assert not nobody_listens(tmp_path)
    assert nobody_listens(key_to(free_port()))


def nobody_listens(where):
    client = Client(where)
    try:
        return client.nobody_listens()
    finally:
        client.close()


def key_to(port):
    return RemoteKey(
        rig="fit-mock",
        name="anna",
        role="commander",
        host="127.0.0.1",
        command_port=port,
        telemetry_port=free_port(),
        server_public=40 * "a",
        public=40 * "b",
        secret=40 * "c",
    )
