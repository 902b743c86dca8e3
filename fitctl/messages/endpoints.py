"""Where a supervisor's sockets are: a folder that only their owner may enter."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

import zmq

from fitctl.config import ConfigError, Rig

COMMAND_SOCKET = "command"
TELEMETRY_SOCKET = "telemetry"
RECORDS_SOCKET = "records"
GATEWAY_SOCKET = "gateway"
_LONGEST_SOCKET_PATH = 100  # sun_path holds 108 bytes


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
    except (RuntimeError, ValueError) as error:  # no such user; a NUL or half a character in it
        msg = f"service.folder: {given!r}: {error}; choose another"
        raise ConfigError(msg) from None
    if size > _LONGEST_SOCKET_PATH or b"\0" in os.fsencode(folder):
        msg = f"service.folder: {str(folder)!r} is too long for a Unix socket, or no path; choose another"
        raise ConfigError(msg)
    return folder


def _own_folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "fitctl"
    return Path(tempfile.gettempdir()) / f"fitctl-{os.getuid()}"


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
        If it cannot be made, belongs to someone else or is open to others.
    """
    folder = service_folder(rig)
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        msg = f"service.folder: {folder} cannot be made: {error.strerror}; choose one that you may write in"
        raise ConfigError(msg) from None
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
        msg = f"service.folder: {folder} must belong to you with mode 0700; remove it or choose another"
        raise ConfigError(msg)
    return folder
