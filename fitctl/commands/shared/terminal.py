"""Whether there is a terminal to ask on and to draw on."""

from __future__ import annotations

import sys


def has_terminal() -> bool:
    """Whether input, output and error output all are a terminal: Textual draws on the error output."""
    streams = (sys.stdin, sys.stdout, sys.stderr)
    return all(stream is not None and stream.isatty() for stream in streams)
