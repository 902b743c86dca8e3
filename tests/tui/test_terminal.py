"""The console on a terminal, while its process is stopped and continued."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

import pytest

CONSOLE = """
import faulthandler
import signal
import sys
from pathlib import Path
from fitctl.commands.operate.console import _run
from fitctl.messages.client import Client
from fitctl.tui.app import ConsoleApp

faulthandler.register(signal.SIGUSR1, file=open(sys.argv[2], "w"))
_run(ConsoleApp(Client(Path(sys.argv[1]))))
"""
CONTINUED_WHILE_IT_WRITES = """
import queue
import signal

put, left = queue.Queue._put, [1]


def put_and_continue(self, item):  # the queue's lock is held here
    put(self, item)
    if left and isinstance(item, str) and "Operate" in item:
        left.clear()
        signal.raise_signal(signal.SIGCONT)


queue.Queue._put = put_and_continue
"""
LIMIT_S = 30.0
TO_ALTERNATE_SCREEN = b"\x1b[?1049h"


class OnTerminal:
    """A console without a supervisor, on a pseudo-terminal whose other end is read."""

    def __init__(self, folder, program=CONSOLE):
        self._terminal, self.inside = pty.openpty()
        termios.tcsetwinsize(self.inside, (40, 140))
        self.modes_before = termios.tcgetattr(self.inside)
        self.shown = b""
        self._stacks = folder.with_name("stacks")
        # Tests before this one may have set a terminal's size: at 80 columns an alarm takes the row of tabs.
        env = {
            name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}
        }
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, str(folder), str(self._stacks)],
            stdin=self.inside,
            stdout=self.inside,
            stderr=self.inside,
            start_new_session=True,
            env=env
            | {"TERM": "xterm-256color", "OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(folder.parent)},
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        with contextlib.suppress(OSError):  # once it is closed
            while True:
                self.shown += os.read(self._terminal, 65536)

    def close(self):
        """Close the terminal, as its window does, or the network."""
        os.close(self.inside)
        os.close(self._terminal)
        self.process.send_signal(signal.SIGHUP)

    def press(self, key):
        os.write(self._terminal, key)

    def threads(self):
        """How many its process has."""
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))

    def stop_and_continue(self):
        before = len(self.shown)
        self.process.send_signal(signal.SIGSTOP)
        os.waitpid(self.process.pid, os.WUNTRACED)
        self.process.send_signal(signal.SIGCONT)
        try:
            until(
                lambda: b"Operate" in self.shown[before:].partition(TO_ALTERNATE_SCREEN)[2],
                "drawn anew",
            )
        except AssertionError as error:
            self.process.send_signal(signal.SIGUSR1)
            time.sleep(1.0)
            since = self.shown[before : before + 4000]
            error.add_note(f"shown since: {since!r}\n{self._stacks.read_text()}")
            raise


def until(holds, what):
    """Wait until something holds."""
    end_s = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < end_s, f"not within {LIMIT_S:g} s: {what}"
        time.sleep(0.05)


@pytest.fixture
def console(tmp_path):
    """On its terminal, with its first screen drawn."""
    console = OnTerminal(tmp_path / "nobody")
    try:
        until(lambda: b"Operate" in console.shown, "the first screen")
        yield console
    finally:
        console.process.kill()
        console.process.wait()


@pytest.mark.long
def test_a_console_that_is_stopped_and_continued_has_as_many_threads_as_before(console):
    until(lambda: console.threads() == 6, "its own threads, and none of a command")
    for _ in range(3):
        console.stop_and_continue()
    until(lambda: console.threads() == 6, f"6 threads; there are {console.threads()}")


@pytest.mark.long
def test_a_console_that_was_stopped_and_continued_ends_and_leaves_the_terminal_as_it_was(console):
    console.stop_and_continue()
    console.press(b"q")
    assert console.process.wait(LIMIT_S) == 0
    assert termios.tcgetattr(console.inside) == console.modes_before


@pytest.mark.long
def test_a_console_whose_terminal_closes_ends_and_leaves_no_folder(console, tmp_path):
    console.press(b"4")
    until(lambda: list(tmp_path.glob("fitctl-console-*")), "the folder of edited sequences")
    console.close()
    assert console.process.wait(LIMIT_S) == 0
    assert list(tmp_path.glob("fitctl-console-*")) == []


@pytest.mark.long
def test_a_console_that_is_continued_while_it_writes_goes_on(tmp_path):
    console = OnTerminal(tmp_path / "nobody", CONTINUED_WHILE_IT_WRITES + CONSOLE)
    try:
        until(lambda: console.shown.count(TO_ALTERNATE_SCREEN) == 2, "its terminal set up anew")
        until(lambda: b"Operate" in console.shown.rpartition(TO_ALTERNATE_SCREEN)[2], "drawn anew")
        console.press(b"q")
        assert console.process.wait(LIMIT_S) == 0
    finally:
        console.process.kill()
        console.process.wait()
