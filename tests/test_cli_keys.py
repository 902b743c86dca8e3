"""`fitctl keys`, and commands that go by a key file."""

import pytest
from served import Served

from fitctl.cli import main
from fitctl.supervisor.messages import Status, TakeOver


def fitctl(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return ended.value.code or 0


@pytest.fixture
def settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keys = ["service.tcp_address=10.0.0.5", f"service.keys_folder={tmp_path / 'keys'}"]
    return [part for key in keys for part in ("--set", key)]


def test_a_key_is_made_listed_and_revoked(settings, tmp_path, capsys):
    assert fitctl("keys", "new", "anna", *settings) == 0
    assert fitctl("keys", "new", "bob", "--viewer", "--host", "rig.example.org", *settings) == 0
    assert "viewer bob of rig fit-mock at rig.example.org" in capsys.readouterr().out
    assert 'host = "10.0.0.5"' in (tmp_path / "anna.key.toml").read_text()

    assert fitctl("keys", "list", *settings) == 0
    listed = capsys.readouterr().out
    assert [line.split()[:2] for line in listed.splitlines()] == [
        ["anna", "commander"],
        ["bob", "viewer"],
    ]

    assert fitctl("keys", "revoke", "anna", *settings) == 0
    capsys.readouterr()
    assert fitctl("keys", "list", *settings) == 0
    assert "anna" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["keys", "new", "../anna"], "cannot be a name"),
        (["keys", "revoke", "anna"], "no key is named anna; there are none"),
        (["send", "status", "--remote", "none.toml"], "none.toml: cannot be read"),
        (["keys", "new", "anna", "--set", "service.tcp_address=rig"], "service.tcp_address"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(settings, capsys, arguments, complaint):
    own = settings if arguments[0] == "keys" else []

    assert fitctl(*arguments[:3], *own, *arguments[3:]) == 2

    told = capsys.readouterr().err
    assert complaint in told
    assert len(told.splitlines()) == 1


def test_a_key_made_for_a_rig_that_does_not_listen_says_so(settings, capsys):
    off = ["--set", "service.tcp_address=", "--host", "rig"]

    assert fitctl("keys", "new", "anna", *settings, *off) == 0
    assert "listens to nobody yet" in capsys.readouterr().out


def test_send_reaches_a_rig_by_its_key_file_alone(tmp_path, capsys):
    served = Served(tmp_path, tcp=True)
    served.start()
    try:
        served.key("anna")
        file = tmp_path / "anna.key.toml"

        assert fitctl("send", "status", "--remote", file) == 0
        assert capsys.readouterr().out == "right OFF\n"
        served.client.send(TakeOver())
        assert fitctl("send", "hold", "--remote", file) == 1
        assert "has the instrument" in capsys.readouterr().err
        assert fitctl("send", "stop", "--remote", file) == 0
        assert served.client.send(Status()).text == "right SAFE"
        assert fitctl("send", "stop", "--remote", file, "--rig", "x.toml") == 2
        assert "leave out --rig" in capsys.readouterr().err
    finally:
        served.close()
