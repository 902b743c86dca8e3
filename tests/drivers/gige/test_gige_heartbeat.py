from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.heartbeat import Heartbeat


class SlowChannel:
    """A camera whose answers take a while."""

    endpoint: Any = None
    answered_s = 0.0

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.waiting = 0

    def read_register(self, _address: int) -> int:
        self.waiting += 1
        self.asked.set()
        time.sleep(0.1)
        self.waiting -= 1
        return protocol.CONTROL

    def write_register(self, address: int, value: int) -> None:
        raise NotImplementedError


def test_once_it_has_stopped_nothing_is_asked_of_the_camera() -> None:
    channel, clock = SlowChannel(), SimpleNamespace(runs=False)
    heartbeat = Heartbeat(channel, clock, heartbeat_s=0.03)  # type: ignore[arg-type]
    assert channel.asked.wait(10.0)
    heartbeat.stop()
    assert channel.waiting == 0
