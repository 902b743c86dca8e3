"""Where a supervisor's sockets are: a folder that only their owner may enter.

The folder is the same in every session of a user: it depends on the user database and on the machine, never
on the environment. Server and clients both refuse a folder that somebody else could have put there.
"""

from __future__ import annotations

import grp
import os
import pwd
import socket
import stat
import threading
from contextlib import suppress
from pathlib import Path

import zmq

from fitctl.config import ConfigError, Rig

COMMAND_SOCKET = "command"
TELEMETRY_SOCKET = "telemetry"
RECORDS_SOCKET = "records"
GATEWAY_SOCKET = "gateway"
_LONGEST_SOCKET_PATH = 98  # sun_path holds 108 bytes; `supervisor_name` has more before the folder
_MOST_LINKS = 40  # as the kernel
_TO_FOLDER = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
_MACHINE_ID = Path("/etc/machine-id")


def service_folder(rig: Rig) -> Path:
    """The folder of a rig's sockets; two rigs of one user do not meet there.

    Raises
    ------
    ConfigError
        If no socket could ever be there.
    """
    given = rig.service.folder
    try:
        folder = Path(given).expanduser().absolute() if given else _own_folder() / rig.name
        size = len(os.fsencode(folder / TELEMETRY_SOCKET))
    except KeyError:
        msg = f"service.folder: user {os.getuid()} is not in the user database; name a folder"
        raise ConfigError(msg) from None
    except (RuntimeError, ValueError) as error:  # no such user; a NUL or half a character in it
        msg = f"service.folder: {given!r}: {error}; choose another"
        raise ConfigError(msg) from None
    if size > _LONGEST_SOCKET_PATH or b"\0" in os.fsencode(folder):
        msg = f"service.folder: {str(folder)!r} is too long for a Unix socket, or no path; choose another"
        raise ConfigError(msg)
    return folder


def _own_folder() -> Path:
    """In the home folder that the user database names, with a part for this machine: homes may be shared."""
    home = Path(pwd.getpwuid(os.getuid()).pw_dir)
    return home / ".local/state/fitctl" / _machine()


def _machine() -> str:
    with suppress(OSError):
        if (identity := _MACHINE_ID.read_text().strip()) and identity.isalnum():
            return identity[:8]
    return socket.gethostname()


def supervisor_name(folder: Path) -> str:
    """The abstract Unix name that a supervisor holds for its folder."""
    return f"{supervisor_names()}{os.path.realpath(folder)}"


def supervisor_names() -> str:
    """With what the names of this user's supervisors begin; the folder follows."""
    return f"fitctl:{os.getuid()}:"


def tcp_endpoint(host: str, port: int) -> str:
    """As ZeroMQ writes it."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


def keep_alive(tcp_socket: zmq.Socket[bytes]) -> None:
    """Have the kernel notice within about 12 s that a link has broken.

    ZeroMQ's own heartbeats would do, but libzmq 4.3.5 aborts the process when one is due on a connection
    whose peer hung up while its messages were held back (``out_event`` asserts that there was no error).
    """
    tcp_socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
    tcp_socket.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 6)
    tcp_socket.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 2)
    tcp_socket.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)


def make_service_folder(rig: Rig) -> Path:
    """Make the folder, mode 0700.

    Raises
    ------
    ConfigError
        If it cannot be made, or others could have made or could replace a part of its path.
    """
    folder = service_folder(rig)
    try:
        for part in (*reversed(folder.parents), folder):
            with suppress(FileExistsError):
                part.mkdir(mode=0o700)
        os.close(open_folder(folder))
    except OSError as error:
        msg = f"service.folder: {folder} cannot be made: {error.strerror}; choose one that you may write in"
        raise ConfigError(msg) from None
    return folder


def checked_folder(rig: Rig) -> Path:
    """The folder of a rig's sockets, which exists and can be nobody else's.

    Raises
    ------
    ConfigError
        If it is not so.
    """
    folder = service_folder(rig)
    try:
        os.close(open_folder(folder))
    except OSError as error:
        msg = f"service.folder: {folder} cannot be opened: {error.strerror}; start the supervisor first"
        raise ConfigError(msg) from None
    return folder


def open_folder(folder: Path) -> int:
    """Open a socket folder that belongs to this user alone; no part of its path can be another user's.

    Each part is opened relative to the one before it, without following links, and examined once it is
    open. So nothing can be exchanged between the examination and the use. A link is followed
    only where root or this user made it. The descriptor is for paths (``O_PATH``): whatever is reached through
    it (:func:`socket_in`) is in this folder, also when its name leads elsewhere later.

    Parameters
    ----------
    folder : Path
        Absolute.

    Raises
    ------
    ConfigError
        If a part belongs to, or can be replaced by, another user, or the folder is open to others.
    OSError
        If a part does not exist or is no folder.
    """
    pending = list(reversed(folder.parts[1:]))
    at, path, links = os.open("/", _TO_FOLDER), Path("/"), 0
    try:
        while pending:
            name = pending.pop()
            part = os.open(name, _TO_FOLDER, dir_fd=at)
            status = os.fstat(part)
            if fault := foreign_part(path / name, status):
                os.close(part)
                raise ConfigError(_refused(folder, fault))
            if not stat.S_ISLNK(status.st_mode):
                os.close(at)
                at, path = part, path / name
                continue
            target = Path(os.readlink("", dir_fd=part))
            os.close(part)
            if (links := links + 1) > _MOST_LINKS:
                raise ConfigError(_refused(folder, f"{path / name} goes through too many links"))
            pending += reversed(target.parts[1:] if target.is_absolute() else target.parts)
            if target.is_absolute():
                os.close(at)
                at, path = os.open("/", _TO_FOLDER), Path("/")
        status = os.fstat(at)
        if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise ConfigError(_refused(folder, "it must belong to you with mode 0700"))
    except BaseException:
        os.close(at)
        raise
    return at


def _refused(folder: Path, fault: str) -> str:
    return f"service.folder: {folder} is not safe: {fault}; remove it or choose another"


def foreign_part(path: Path, status: os.stat_result) -> str:
    """What allows another user to put something else at a part of a path; empty if nothing does."""
    if status.st_uid not in {0, os.getuid()}:
        return f"{path} belongs to user {status.st_uid}"
    mode = status.st_mode
    if stat.S_ISLNK(mode):
        return ""  # only its owner can change it
    if not stat.S_ISDIR(mode):
        return f"{path} is no folder"
    # In a sticky folder, such as /tmp, nobody can replace what belongs to this user or to root.
    writable = mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not _is_own_group(status.st_gid))
    return f"others can write in {path}" if writable and not mode & stat.S_ISVTX else ""


def _is_own_group(gid: int) -> bool:
    """Root's group, or the group that a user has alone."""
    if gid == 0:
        return True
    try:
        user, group = pwd.getpwuid(os.getuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    return group.gr_name == user.pw_name and set(group.gr_mem) <= {user.pw_name}


def socket_in(folder: int, name: str) -> str:
    """The ZeroMQ endpoint of a socket in a folder that :func:`open_folder` has opened."""
    return f"ipc:///proc/self/fd/{folder}/{name}"


class SocketFolder:
    """A rig's socket folder by its path, examined whenever it is used and opened anew when it was made anew.

    In a folder that :func:`open_folder` accepts, only this user and root can make a socket. What libzmq
    connects to, also when it reconnects by itself, is in the folder that was examined. May be used from any
    thread.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path : Path
        Absolute.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self._opened: list[int] = []  # descriptors; the last is in use, others may still be
        self._lock = threading.Lock()

    def endpoint(self, name: str) -> str:
        """The ZeroMQ endpoint of a socket in it; empty while there is no folder.

        Raises
        ------
        ConfigError
            If the folder could be another user's.
        """
        with self._lock:
            try:
                found = open_folder(self.path)
            except OSError:
                return ""
            if self._opened and os.path.samestat(os.fstat(found), os.fstat(self._opened[-1])):
                os.close(found)
            else:
                self._opened.append(found)
            return socket_in(self._opened[-1], name)

    def close(self) -> None:
        """Close it; safe to call twice."""
        with self._lock:
            while self._opened:
                os.close(self._opened.pop())


def file_identity(path: Path) -> tuple[int, int] | None:
    """Which file is at a path, None if there is none: to notice that it was removed or replaced."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
