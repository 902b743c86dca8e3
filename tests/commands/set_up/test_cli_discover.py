"""What `fitctl discover` reports where its broadcast could not be sent."""

import json

import pytest

from fitctl.cli import main
from fitctl.commands.set_up import discover
from fitctl.drivers.interface import DeviceUnreachable


@pytest.fixture
def listed(monkeypatch, capsys):
    """What is printed, and the exit status, where the search for cameras is as given."""

    def run(cameras, *arguments):
        monkeypatch.setattr(discover, "discover_cameras", cameras)
        monkeypatch.setattr(discover, "discover_labjacks", lambda *_: [])
        with pytest.raises(SystemExit) as ended:
            main(["discover", *arguments])
        printed = capsys.readouterr()
        return ended.value.code or 0, printed.out, printed.err

    return run


def no_network(*_):
    raise DeviceUnreachable("camera", "255.255.255.255", "a network with cameras", "none", "see it")


def test_a_search_that_fails_is_not_taken_for_one_that_finds_nothing(listed):
    status, out, err = listed(no_network)
    assert status == 1
    assert "cameras: not known" in out
    assert "labjacks: none" in out
    assert err.startswith("cameras: camera at 255.255.255.255: ")

    status, out, _ = listed(no_network, "--json")
    found = json.loads(out)
    assert (status, found["cameras"], found["labjacks"]) == (1, None, [])


def test_a_network_without_cameras_is_no_failure(listed):
    status, out, err = listed(lambda *_: [])
    assert (status, err) == (0, "")
    assert "cameras: none" in out
