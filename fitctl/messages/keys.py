"""Keys of remote operation: the server's own pair, the keys that it allows, and the file that a client gets.

In the keys' folder, ``server.toml`` has the server's pair, and ``allowed/NAME.toml`` one allowed public key
each. All are TOML, of mode 0600 and refused if others can read them. No name or path of them ever comes from
the network.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import tempfile
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import msgspec
import zmq
from zmq.utils import z85

from fitctl.config import ConfigError, Rig
from fitctl.files import open_regular
from fitctl.text import UNDECODABLE

Role = Literal["commander", "viewer"]
KeyText = Annotated[str, msgspec.Meta(pattern=r"^[!-~]{40}\Z")]  # Z85, 32 bytes
Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}\Z")]
PortNumber = Annotated[int, msgspec.Meta(ge=1, le=65535)]
_AS_OWNER = "run this as the user whose folder it is"
# What libzmq connects to: a name or an IPv4 address, or an IPv6 address with two colons at least; no port.
_HOST = r"^([A-Za-z0-9][A-Za-z0-9._-]{0,252}|[0-9A-Fa-f.]*:[0-9A-Fa-f.]*:[0-9A-Fa-f.:]*(%[A-Za-z0-9._-]+)?)\Z"


class _Keys(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Refuses what is no Z85 in its keys, which libzmq would refuse later."""

    def __post_init__(self) -> None:
        for field in {"public", "secret", "server_public"}.intersection(self.__struct_fields__):
            try:
                z85.decode(getattr(self, field))
            except (ValueError, KeyError, struct.error):
                msg = f"{field}: expected a key of 40 characters of Z85"
                raise ValueError(msg) from None


class KeyPair(_Keys, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A CURVE key pair, each as 40 characters of Z85."""

    public: KeyText
    secret: KeyText


class AllowedKey(_Keys, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A client that the server lets in."""

    name: Name
    role: Role
    public: KeyText


class RemoteKey(_Keys, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that a client needs to reach one rig."""

    rig: Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]{1,100}\Z")]
    name: Name
    role: Role
    host: Annotated[str, msgspec.Meta(pattern=_HOST)]
    command_port: PortNumber
    telemetry_port: PortNumber
    server_public: KeyText
    public: KeyText
    secret: KeyText


T = TypeVar("T", KeyPair, AllowedKey, RemoteKey)


def keys_folder(rig: Rig) -> Path:
    """Where the keys of a rig are.

    Raises
    ------
    ConfigError
        If no folder can have such a name.
    """
    given = rig.service.keys_folder
    base = given or os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    try:
        folder = Path(base).expanduser()
        with suppress(OSError):
            folder.stat()
    except (RuntimeError, ValueError) as error:  # no such user; a NUL or half a character in it
        msg = f"service.keys_folder: {base!r}: {error}; choose another"
        raise ConfigError(msg) from None
    return folder if given else folder / "fitctl" / "keys" / rig.name


def server_pair(rig: Rig) -> KeyPair:
    """The server's key pair; made when there is none yet.

    Raises
    ------
    ConfigError
        If it cannot be used or made.
    """
    path = keys_folder(rig) / "server.toml"
    if not _exists(path):
        with suppress(FileExistsError):  # another process may have been quicker
            _write_new(path, _new_pair())
    return _read(path, KeyPair)


def new_key(rig: Rig, name: str, role: Role, host: str, out: Path) -> RemoteKey:
    """Make a client's key, allow it, and write the client's file.

    Parameters
    ----------
    rig : Rig
    name : str
        Whose it is: small letters, digits, "-" and "_".
    role : str
    host : str
        How the client reaches this machine; empty for `service.tcp_address`.
    out : Path
        The client's file; it must not exist.

    Raises
    ------
    ConfigError
        If there is such a name or file already, or the address cannot be known.
    """
    service = rig.service
    host = host or service.tcp_address
    if not re.match(_HOST, host) or _is_unspecified(host):
        msg = (
            f"keys: a client cannot reach this machine at {host!r}; give its name or address with --host, "
            "without a port, or set service.tcp_address to one"
        )
        raise ConfigError(msg)
    pair = _new_pair()
    key = RemoteKey(
        rig=rig.name,
        name=name,
        role=role,
        host=host,
        command_port=service.command_port,
        telemetry_port=service.telemetry_port,
        server_public=server_pair(rig).public,
        public=pair.public,
        secret=pair.secret,
    )
    try:
        msgspec.convert(msgspec.to_builtins(key), RemoteKey)
    except msgspec.ValidationError:
        msg = (
            f"keys: {name!r} cannot be a name; use a-z, 0-9, - and _, at most 32, and begin with a letter or "
            "a digit"
        )
        raise ConfigError(msg) from None
    allowed = _allowed_folder(rig) / f"{name}.toml"
    if _exists(allowed):
        msg = f"keys: there is a key {name} already; revoke it first, or choose another name"
        raise ConfigError(msg)
    try:
        _write_new(out, key)
        try:
            _write_new(allowed, AllowedKey(name=name, role=role, public=pair.public))
        except BaseException:
            out.unlink(missing_ok=True)  # it would open nothing
            raise
    except FileExistsError as error:
        msg = f"{error.filename}: exists already; choose another"
        raise ConfigError(msg) from None
    return key


def revoke_key(rig: Rig, name: str) -> None:
    """Let a key in no more; a running supervisor sees it by itself.

    Raises
    ------
    ConfigError
        If there is none of that name.
    """
    known = [path.stem for path in _allowed_paths(rig)]
    if name not in known:
        msg = f"keys: no key is named {name}; the rig has {', '.join(known) or 'none'}"
        raise ConfigError(msg)
    path = _allowed_folder(rig) / f"{name}.toml"
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        msg = (
            f"{path}: cannot be removed: {error.strerror}; the key {name} still opens; {_AS_OWNER}"
        )
        raise ConfigError(msg) from None


def allowed_keys(rig: Rig) -> tuple[dict[str, AllowedKey], list[str]]:
    """The allowed clients by public key, and what is wrong with key files that cannot be used."""
    keys, problems = {}, []
    try:
        paths = _allowed_paths(rig)
    except ConfigError as error:
        return {}, [str(error)]
    for path in paths:
        try:
            key = _read(path, AllowedKey)
        except ConfigError as error:
            problems.append(str(error))
            continue
        if key.name == path.stem:
            keys[key.public] = key
        else:
            problems.append(
                f"{path}: is named {key.name} inside; rename the file, or make it again"
            )
    return keys, problems


def keys_signature(rig: Rig) -> list[tuple[str, int, int, int]]:
    """Something that changes when an allowed key does; cheap enough to be asked all the time."""
    found = []
    try:
        paths = _allowed_paths(rig)
    except ConfigError as error:
        return [(str(error), 0, 0, 0)]
    for path in paths:
        with suppress(OSError):
            status = path.stat()
            found.append((path.name, status.st_ino, status.st_mtime_ns, status.st_mode))
    return found


def read_remote(path: Path) -> RemoteKey:
    """A client's key file.

    Raises
    ------
    ConfigError
        If it cannot be used, or others can read it.
    """
    return _read(path, RemoteKey)


def read_key_of(rig: Rig, path: Path) -> RemoteKey:
    """A client's key file, which must be for this rig.

    Raises
    ------
    ConfigError
        If it cannot be used, or is for another.
    """
    key = read_remote(path)
    if key.rig != rig.name:
        msg = f"{path}: is a key to rig {key.rig}, not {rig.name}; give that rig's file with --rig"
        raise ConfigError(msg)
    return key


def _allowed_folder(rig: Rig) -> Path:
    return keys_folder(rig) / "allowed"


def _allowed_paths(rig: Rig) -> list[Path]:
    """The files of the allowed keys.

    Raises
    ------
    ConfigError
        If their folder is there and cannot be read.
    """
    folder = _allowed_folder(rig)
    try:
        return sorted(folder / name for name in os.listdir(folder) if name.endswith(".toml"))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise _unreadable(folder, error) from None


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be read: {error.strerror}; {_AS_OWNER}")


def _new_pair() -> KeyPair:
    public, secret = zmq.curve_keypair()
    return KeyPair(public=public.decode(), secret=secret.decode())


def _is_unspecified(host: str) -> bool:
    try:
        return ip_address(host).is_unspecified
    except ValueError:
        return False  # a name


def _read(path: Path, kind: type[T]) -> T:
    """A key file that nobody else can read.

    Its mode is asked of the open file, so that it is the one that is read.
    """
    try:
        with open_regular(path) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            text = file.read(65536)
        if mode & 0o077:
            leaked = (
                "delete it and make all keys again" if kind is KeyPair else "revoke it"
            )  # the server's own pair cannot be revoked
            msg = (
                f"{path}: other users can read it (mode {mode:04o}); if another user may have read it, "
                f"{leaked}; otherwise: chmod 600"
            )
            raise ConfigError(msg)
        return msgspec.toml.decode(text, type=kind)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror}; `fitctl keys new` makes key files"
        raise ConfigError(msg) from None
    except UNDECODABLE as error:
        msg = f"{path}: is not a key file of fitctl: {error}; `fitctl keys new` makes them"
        raise ConfigError(msg) from None


def _write_new(path: Path, content: msgspec.Struct) -> None:
    """Write a file that must not exist, mode 0600, in one step."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Made with mode 0600 from the beginning, and given its name when it is complete.
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".key-") as file:
            file.write(msgspec.toml.encode(content))
            file.flush()
            os.fsync(file.fileno())
            os.link(file.name, path)
    except OSError as error:
        if isinstance(error, FileExistsError) and error.filename2 is not None:  # of the link
            raise FileExistsError(0, "exists", str(path)) from None
        msg = f"{path}: cannot be written: {error.strerror}; choose another place"
        raise ConfigError(msg) from None
