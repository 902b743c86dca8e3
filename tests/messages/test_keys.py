"""Key files: made once, for their owner's eyes alone, and refused when they are anything else."""

import errno
import os
import stat

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instruments.served import rig_in

from fitctl.config import ConfigError
from fitctl.messages.keys import (
    allowed_keys,
    keys_folder,
    keys_signature,
    new_key,
    read_key_of,
    read_remote,
    revoke_key,
    server_pair,
)


@pytest.fixture
def rig(tmp_path):
    return rig_in(tmp_path, "service.tcp_address=127.0.0.1")


def test_a_new_key_is_allowed_and_its_file_reaches_the_server(rig, tmp_path):
    made = new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")

    keys, problems = allowed_keys(rig)
    assert not problems
    assert keys[made.public].name == "anna"
    assert read_remote(tmp_path / "anna.toml") == made
    assert made.server_public == server_pair(rig).public
    assert made.host == "127.0.0.1"


def test_the_secret_of_a_client_is_in_no_file_of_the_server(rig, tmp_path):
    made = new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")

    files = [path for path in keys_folder(rig).rglob("*") if path.is_file()]
    assert files
    assert all(made.secret not in path.read_text() for path in files)


def test_every_file_is_for_its_owner_alone(rig, tmp_path):
    previous = os.umask(0)
    try:
        new_key(rig, "anna", "viewer", "", tmp_path / "anna.toml")
    finally:
        os.umask(previous)

    files = [*keys_folder(rig).rglob("*.toml"), tmp_path / "anna.toml"]
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    assert stat.S_IMODE(keys_folder(rig).stat().st_mode) == 0o700


def test_the_servers_pair_is_made_once(rig):
    assert server_pair(rig) == server_pair(rig)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o666])
def test_a_key_that_others_may_read_is_refused(rig, tmp_path, mode):
    new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")
    for path in (tmp_path / "anna.toml", keys_folder(rig) / "server.toml"):
        path.chmod(mode)
    (keys_folder(rig) / "allowed" / "anna.toml").chmod(mode)

    with pytest.raises(ConfigError, match="chmod 600"):
        read_remote(tmp_path / "anna.toml")
    with pytest.raises(ConfigError, match="chmod 600"):
        server_pair(rig)
    keys, problems = allowed_keys(rig)
    assert not keys
    assert "chmod 600" in problems[0]


def test_no_name_is_given_twice_and_no_file_written_over(rig, tmp_path):
    new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")

    with pytest.raises(ConfigError, match="revoke it first"):
        new_key(rig, "anna", "viewer", "", tmp_path / "other.toml")
    with pytest.raises(ConfigError, match="exists already"):
        new_key(rig, "carl", "viewer", "", tmp_path / "anna.toml")
    assert len(allowed_keys(rig)[0]) == 1


@pytest.mark.parametrize(
    "name", ["", "../x", "Anna", "a b", "x" * 33, "a/b", "root@here", "ä", "e\n"]
)
def test_a_name_is_never_a_path_nor_a_local_user(rig, tmp_path, name):
    with pytest.raises(ConfigError, match="cannot be a name"):
        new_key(rig, name, "commander", "", tmp_path / "key.toml")
    assert not list(tmp_path.rglob("*.key*"))
    assert not (tmp_path / "key.toml").exists()


@pytest.mark.parametrize("host", ["cafe", "1.2.3", "fe80::1%eth0", "fit-1.example"])
def test_a_name_that_looks_like_an_address_is_a_name(rig, tmp_path, host):
    new_key(rig, "anna", "commander", host, tmp_path / "anna.toml")

    assert read_remote(tmp_path / "anna.toml").host == host


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('host = "127.0.0.1"', 'host = "ho st"'),
        ('host = "127.0.0.1"', 'host = "127.0.0.1:7420"'),
        ('host = "127.0.0.1"', f'host = "{"a" * 300}"'),
        ('rig = "fit-mock"', 'rig = "x\\nfit-mock: well"'),
        ('host = "127.0.0.1"', 'host = "127.0.0.1\\n"'),
        ("server_public", f'server_public = "{40 * "#"}"'),
        ("secret", f'secret = "{40 * "~"}"'),
    ],
)
def test_a_key_file_that_leads_nowhere_is_refused_by_name(rig, tmp_path, before, after):
    path = tmp_path / "anna.toml"
    new_key(rig, "anna", "commander", "", path)
    lines = [after if line.startswith(before) else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))

    with pytest.raises(ConfigError, match=r"anna\.toml: is not a key file of fitctl: "):
        read_remote(path)


@pytest.mark.parametrize("folder", ["~nosuchuser/x", "a\0b"])
def test_a_folder_of_keys_that_cannot_be_is_refused(rig, folder):
    service = rig.service.model_copy(update={"keys_folder": folder})

    with pytest.raises(ConfigError, match=r"service\.keys_folder: .*; choose another"):
        keys_folder(rig.model_copy(update={"service": service}))


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "ho st", "-x", "a/b", "a\n", ":", "10.0.0.5:6000", "rig.example.org:6000"],
)
def test_an_address_that_is_none_is_no_place_to_reach(rig, tmp_path, host):
    with pytest.raises(ConfigError, match="--host"):
        new_key(rig, "anna", "commander", host, tmp_path / "key.toml")


def test_a_revoked_key_is_gone_and_may_be_made_anew(rig, tmp_path):
    first = new_key(rig, "anna", "commander", "", tmp_path / "1.toml")
    before = keys_signature(rig)
    revoke_key(rig, "anna")
    second = new_key(rig, "anna", "commander", "", tmp_path / "2.toml")

    assert keys_signature(rig) != before
    assert first.public != second.public
    assert list(allowed_keys(rig)[0]) == [second.public]


def test_revoking_nobody_names_who_there_is(rig, tmp_path):
    new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")

    with pytest.raises(ConfigError, match="the rig has anna"):
        revoke_key(rig, "../server")


def test_a_renamed_file_allows_nobody(rig, tmp_path):
    new_key(rig, "anna", "viewer", "", tmp_path / "anna.toml")
    allowed = keys_folder(rig) / "allowed"
    (allowed / "anna.toml").rename(allowed / "carl.toml")

    keys, problems = allowed_keys(rig)
    assert not keys
    assert "is named anna inside" in problems[0]


def test_a_key_of_another_rig_is_refused(rig, tmp_path):
    new_key(rig, "anna", "viewer", "", tmp_path / "anna.toml")

    with pytest.raises(ConfigError, match="not other"):
        read_key_of(rig.model_copy(update={"name": "other"}), tmp_path / "anna.toml")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
@given(content=st.binary(max_size=300) | st.text(max_size=100).map(str.encode))
def test_anything_that_is_no_key_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "key.toml"
    path.write_bytes(content)
    path.chmod(0o600)

    with pytest.raises(ConfigError) as refused:
        read_remote(path)

    assert str(refused.value).startswith(str(path))
    assert len(str(refused.value).splitlines()) == 1


def test_a_missing_file_a_folder_and_a_pipe_are_told(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "none.toml", tmp_path / "pipe"):
        with pytest.raises(ConfigError, match="cannot be read"):
            read_remote(path)


def test_a_key_that_cannot_be_allowed_leaves_no_secret_behind(rig, tmp_path):
    server_pair(rig)
    (keys_folder(rig) / "allowed").write_text("a file where a folder belongs")

    with pytest.raises(ConfigError, match=r"allowed"):
        new_key(rig, "anna", "viewer", "", tmp_path / "anna.toml")
    assert not (tmp_path / "anna.toml").exists()


def test_a_folder_of_another_user_is_named_and_lets_nobody_in(rig, tmp_path, monkeypatch):
    new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")

    def denied(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "listdir", denied)
    with pytest.raises(ConfigError, match="Permission denied; run this as the user whose folder"):
        revoke_key(rig, "anna")
    keys, problems = allowed_keys(rig)
    assert keys == {}
    assert len(problems) == 1
    assert keys_signature(rig) != []  # the gateway looks again, and reports it


def test_a_key_that_cannot_be_removed_is_said_to_open_still(rig, tmp_path):
    new_key(rig, "anna", "commander", "", tmp_path / "anna.toml")
    file = keys_folder(rig) / "allowed" / "anna.toml"
    file.unlink()
    file.mkdir()

    with pytest.raises(ConfigError, match=r"cannot be removed: .*the key anna still opens"):
        revoke_key(rig, "anna")
