"""The socket folder: the same in every session, and nobody else's."""

import multiprocessing
import os
import stat
import tempfile
import time
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
import zmq

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.messages import endpoints
from fitctl.messages.client import Client
from fitctl.messages.commands import Reply, Stop
from fitctl.messages.endpoints import (
    COMMAND_SOCKET,
    foreign_part,
    make_service_folder,
    open_folder,
    service_folder,
)

SOMEBODY = 65534
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")


def answer_everything(path, ready):
    """Another user's program."""
    os.setgroups([])
    os.setgid(SOMEBODY)
    os.setuid(SOMEBODY)
    router = zmq.Context().socket(zmq.ROUTER)
    router.bind(f"ipc://{path}")
    ready.set()
    while True:
        client, tag, _ = router.recv_multipart()
        router.send_multipart([client, tag, msgspec.msgpack.encode(Reply(accepted=True))])


def folder_setting(folder):
    return load_rig(default_rig_path(), [f"service.folder={folder}"])


def status(uid, mode, gid=0):
    return os.stat_result((mode, 1, 1, 1, uid, gid, 0, 0, 0, 0))


@pytest.fixture
def shared():
    """A folder that everybody may write in, as /tmp; sticky."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        yield folder


@pytest.mark.parametrize("variable", ["XDG_RUNTIME_DIR", "XDG_STATE_HOME", "HOME", "TMPDIR"])
def test_no_environment_leads_elsewhere(monkeypatch, tmp_path, variable):
    before = service_folder(load_rig(default_rig_path()))

    monkeypatch.setenv(variable, str(tmp_path))
    assert service_folder(load_rig(default_rig_path())) == before
    monkeypatch.delenv(variable)
    assert service_folder(load_rig(default_rig_path())) == before


def test_machines_that_share_a_home_do_not_share_the_folder(monkeypatch, tmp_path):
    folders = set()
    for number in range(2):
        (tmp_path / "id").write_text(f"{number}" * 32)
        monkeypatch.setattr(endpoints, "_MACHINE_ID", tmp_path / "id")
        folders.add(service_folder(load_rig(default_rig_path())))

    assert len(folders) == 2


@pytest.mark.parametrize(
    ("found", "complaint"),
    [
        (status(4242, stat.S_IFDIR | 0o700), "belongs to user 4242"),
        (status(4242, stat.S_IFLNK | 0o777), "belongs to user 4242"),
        (status(0, stat.S_IFDIR | 0o777), "others can write"),
        (status(0, stat.S_IFDIR | 0o775, gid=4242), "others can write"),
        (status(0, stat.S_IFREG | 0o600), "no folder"),
        (status(0, stat.S_IFDIR | 0o1777), ""),
        (status(0, stat.S_IFDIR | 0o755), ""),
        (status(0, stat.S_IFLNK | 0o777), ""),
    ],
)
def test_who_could_put_something_else_at_a_part_of_the_path(found, complaint):
    fault = foreign_part(Path("/x"), found)

    assert complaint in fault
    assert bool(fault) == bool(complaint)


def test_every_part_of_the_path_is_examined_also_where_nobody_is_root(shared, monkeypatch):
    """The owner check without a second user: the kernel's answer for one part is another user's."""
    folder = shared / "parent" / "s"
    make_service_folder(folder_setting(folder))
    foreign = (shared / "parent").stat().st_ino
    fstat = os.fstat

    def fake(descriptor):
        found = fstat(descriptor)
        return status(4242, found.st_mode) if found.st_ino == foreign else found

    monkeypatch.setattr(os, "fstat", fake)
    with pytest.raises(ConfigError, match="belongs to user 4242"):
        open_folder(folder)


@as_root
@pytest.mark.parametrize("part", ["parent", "parent/s"])
def test_a_part_that_another_user_made_first_is_refused_by_the_supervisor(shared, part):
    folder = shared / "parent" / "s"
    folder.mkdir(parents=True, mode=0o700)
    os.chown(shared / part, SOMEBODY, SOMEBODY)

    with pytest.raises(ConfigError, match=f"belongs to user {SOMEBODY}"):
        make_service_folder(folder_setting(folder))


@as_root
def test_another_users_link_is_not_followed_although_it_leads_to_a_folder_of_ours(shared, tmp_path):
    make_service_folder(folder_setting(tmp_path / "own"))
    link = shared / "link"
    link.symlink_to(tmp_path / "own")
    os.close(open_folder(link))  # our own is
    os.chown(link, SOMEBODY, SOMEBODY, follow_symlinks=False)

    with pytest.raises(ConfigError, match=f"belongs to user {SOMEBODY}"):
        open_folder(link)


def test_links_that_lead_to_each_other_are_refused(shared):
    (shared / "a").symlink_to(shared / "b")
    (shared / "b").symlink_to(shared / "a")

    with pytest.raises(ConfigError, match="too many links"):
        open_folder(shared / "a")


@as_root
@pytest.mark.parametrize("made_by_owner", [False, True])
def test_another_users_program_never_answers_the_owners_stop(shared, made_by_owner):
    """As it was found: another user made the parent first, and "accepted" came from nobody's instrument."""
    parent = shared / "fitctl-0"
    folder = parent / "s"
    folder.mkdir(parents=True, mode=0o777)
    folder.chmod(0o700 if made_by_owner else 0o777)
    os.chown(parent, SOMEBODY, SOMEBODY)
    if not made_by_owner:
        os.chown(folder, SOMEBODY, SOMEBODY)
    socket = parent / "socket" if made_by_owner else folder / COMMAND_SOCKET
    fork = multiprocessing.get_context("fork")
    ready = fork.Event()
    impostor = fork.Process(target=answer_everything, args=(socket, ready), daemon=True)
    impostor.start()
    try:
        assert ready.wait(20.0)
        if made_by_owner:  # the parent is the other user's, who may exchange the folder in it
            folder.rename(parent / "away")
            folder.mkdir(mode=0o700)
            socket.rename(folder / COMMAND_SOCKET)
        with (
            closing(Client(folder)) as client,
            pytest.raises(ConnectionError, match=f"belongs to user {SOMEBODY}"),
        ):
            client.send(Stop(), timeout_s=2.0)
    finally:
        impostor.kill()
        impostor.join()


@as_root
def test_a_client_stays_with_the_folder_that_it_examined(shared):
    """Exchanged between examination and use: libzmq connects by itself, again and again, by name."""
    folder = shared / "s"
    make_service_folder(folder_setting(folder))
    with closing(Client(folder)) as client:
        endpoint = client._endpoint(COMMAND_SOCKET)
        folder.rename(shared / "away")
        folder.mkdir(mode=0o777)
        os.chown(folder, SOMEBODY, SOMEBODY)
        (folder / COMMAND_SOCKET).touch()

        assert not Path(endpoint.removeprefix("ipc://")).exists()
        begun_s = time.monotonic()
        with pytest.raises(ConnectionError, match=f"belongs to user {SOMEBODY}"):
            client.send(Stop(), timeout_s=2.0)
        assert time.monotonic() - begun_s < 1.0
