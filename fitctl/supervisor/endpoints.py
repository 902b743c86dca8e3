"""Where a supervisor's sockets are: a folder that only their owner may enter."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from fitctl.config import ConfigError, Rig

COMMAND_SOCKET = "command"
TELEMETRY_SOCKET = "telemetry"
RECORDS_SOCKET = "records"
_LONGEST_SOCKET_PATH = 100  # sun_path holds 108 bytes


def service_folder(rig: Rig) -> Path:
    """The folder of a rig's sockets; two rigs of one user do not meet there."""
    if rig.service.folder:
        return Path(rig.service.folder).expanduser().absolute()
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = (
        Path(runtime) / "fitctl"
        if runtime
        else Path(tempfile.gettempdir()) / f"fitctl-{os.getuid()}"
    )
    return base / rig.name


def make_service_folder(rig: Rig) -> Path:
    """Make the folder, mode 0700.

    Raises
    ------
    ConfigError
        If it cannot be made, belongs to someone else, is open to others, or its path is too long for a
        socket.
    """
    folder = service_folder(rig)
    if len(str(folder / TELEMETRY_SOCKET)) > _LONGEST_SOCKET_PATH:
        msg = f"service.folder: {folder} is too long for a Unix socket; choose a shorter one"
        raise ConfigError(msg)
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        msg = f"service.folder: {folder} cannot be made: {error.strerror}"
        raise ConfigError(msg) from None
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
        msg = f"service.folder: {folder} must belong to you with mode 0700; remove it or choose another"
        raise ConfigError(msg)
    return folder
