"""Reports to systemd, if it started fitctl: ready, alive, ending. See sd_notify(3)."""

from __future__ import annotations

import os
import socket
from contextlib import suppress

READY = "READY=1"
ALIVE = "WATCHDOG=1"
ENDING = "STOPPING=1"


def tell_service_manager(*lines: str) -> None:
    """Send these lines to ``NOTIFY_SOCKET``; without one, nothing.

    Never waits: a manager that does not read misses them. One that is deaf must not end the instrument,
    so no error is raised.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]  # of Linux's abstract namespace
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.setblocking(False)
        manager.sendto("\n".join(lines).encode(), address)


def status_line(text: str) -> str:
    """What ``systemctl status`` shows."""
    return f"STATUS={text}"
