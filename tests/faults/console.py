"""A console on a terminal of its own, as somebody would have it open."""

import fcntl
import os
import select
import struct
import subprocess
import sys
import termios
import threading

from system.conftest import end

ROWS, COLUMNS = 30, 100


class Console:
    """`fitctl console` on a pseudo-terminal that is read as long as `reads` is set.

    Attributes
    ----------
    drawn : int
        Bytes that it has written so far.
    """

    def __init__(self, arguments):
        self._ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fitctl", "console", *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env=os.environ | {"TERM": "xterm-256color"},
            start_new_session=True,
        )
        os.close(theirs)
        self.drawn = 0
        self.reads = threading.Event()
        self.reads.set()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        while not self._ending.is_set():
            if not self.reads.wait(0.1) or not select.select([self._ours], [], [], 0.1)[0]:
                continue
            try:
                self.drawn += len(os.read(self._ours, 65536))
            except OSError:  # its other end is closed: the console has gone
                return

    def quit(self):
        """Press q; returns the exit status."""
        os.write(self._ours, b"q")
        return self.process.wait(20)

    def close(self):
        self.reads.set()
        end(self.process)
        self._ending.set()
        self._thread.join()
        os.close(self._ours)
