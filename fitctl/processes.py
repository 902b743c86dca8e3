"""fitctl's own processes: starting one, ending one, and noticing that a parent has gone."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import pwd
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PARENT_CHECK_S = 0.25
_LONGEST_NAME = 107  # sun_path, without the NUL before it


def rig_arguments(path: Path, overrides: Sequence[str]) -> list[str]:
    """Options that give another fitctl process the same rig."""
    return ["--rig", str(path), *(part for text in overrides for part in ("--set", text))]


def start_process(
    arguments: Sequence[str],
    *,
    stdout: int | None = subprocess.DEVNULL,
    stderr: IO[bytes] | None = None,
) -> subprocess.Popen[bytes]:
    """Start ``fitctl ARGUMENTS`` in a session of its own, so that Ctrl-C reaches only its parent.

    It is told our process id, and ends by itself when we are gone (:func:`end_with_parent`).
    """
    return subprocess.Popen(
        [sys.executable, "-m", "fitctl", *arguments, "--parent-pid", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        start_new_session=True,
    )


def show_process(arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start ``fitctl ARGUMENTS`` on our own terminal."""
    return subprocess.Popen([sys.executable, "-m", "fitctl", *arguments])


def end_process(process: subprocess.Popen[bytes], timeout_s: float) -> None:
    """Ask a process to end, and insist when it does not within `timeout_s`."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    if process.stdout is not None:
        process.stdout.close()


@contextmanager
def ended_by_signals(end: Callable[[], None]) -> Iterator[None]:
    """Call `end` at SIGINT, SIGTERM and SIGHUP, instead of what they do by themselves."""

    def handler(_signal: int, _frame: object) -> None:
        end()

    before = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, action in before.items():
            signal.signal(number, action)


def interrupt() -> None:
    """End as Ctrl-C does, letting go of everything: for :func:`ended_by_signals`."""
    raise KeyboardInterrupt


@contextmanager
def signals_ignored() -> Iterator[None]:
    """Let nothing interrupt what must be finished, such as letting go of everything."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, action in before.items():
            signal.signal(number, action)


def give_way(niceness: int) -> None:
    """Let all other processes run first, as far as `niceness`, 1 to 19, says.

    Where Linux has autogroups, it shares the processor between sessions first, and niceness counts only within
    one: the leader of a session lowers the whole session.
    """
    os.nice(niceness)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # no autogroups
            Path("/proc/self/autogroup").write_text(str(niceness))


def limit_memory(most_bytes: int) -> None:
    """Let this process have so many bytes of data at most, or fewer where it may have no more."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or hard > most_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, hard))


@contextmanager
def lock_held(path: Path) -> Iterator[None]:
    """Hold a lock file, with our process id in it, for as long as we live at the most.

    Raises
    ------
    BlockingIOError
        If another process holds it; ``strerror`` names it.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            raise BlockingIOError(error.errno, f"process {owner}", str(path)) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        yield
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


@contextmanager
def name_held(name: str) -> Iterator[None]:
    """Hold an abstract Unix name, for as long as we live at the most.

    The kernel gives it to one process of the machine, whatever its user and its environment; no file can be
    deleted under it.

    Raises
    ------
    BlockingIOError
        If another process holds it; ``strerror`` names it.
    """
    # Nobody is ever accepted: who connects is told who holds it (SO_PEERCRED).
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as held:
        try:
            held.bind(_abstract(name))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise BlockingIOError(error.errno, name_holder(name), name) from None
        held.listen(socket.SOMAXCONN)
        yield


def name_holder(name: str) -> str:
    """Process and user that hold an abstract name, for people."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as asking:
        try:
            asking.connect(_abstract(name))
            found = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        except OSError:
            return "an unknown process"
    pid, uid, _ = struct.unpack("3i", found)
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = str(uid)
    return f"process {pid} of user {user}"


def names_held(prefix: str) -> list[str]:
    """Abstract names that processes of this machine listen at, and that begin so.

    Anyone can hold any name: what a name says must be checked.
    """
    found = []
    for line in Path("/proc/net/unix").read_text(errors="replace").split("\n"):
        _, at, name = line.partition(" @")
        if at and name.startswith(prefix):
            found.append(name)
    return sorted(set(found))


def _abstract(name: str) -> bytes:
    """As the kernel has it; a long name is held by its digest."""
    whole = os.fsencode(name)
    if len(whole) > _LONGEST_NAME:
        whole = b"fitctl#" + hashlib.sha256(whole).hexdigest().encode()
    return b"\0" + whole


def last_line(path: Path) -> str:
    """The last line that a process wrote to its error file, or nothing."""
    try:
        lines = path.read_text(errors="replace").split("\n")
    except OSError:
        return ""
    return next((line for line in reversed(lines) if line.strip()), "")


def end_with_parent(parent_pid: int | None) -> None:
    """Send SIGTERM to this process once its parent has gone; None means that nobody minds.

    A parent that was killed cannot end its children; this leaves none behind.
    """
    if parent_pid is None:
        return

    def watch() -> None:
        gone = threading.Event()
        while os.getppid() == parent_pid:
            gone.wait(_PARENT_CHECK_S)
        with suppress(ProcessLookupError):
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
