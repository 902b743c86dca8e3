"""The event loop that mocks run on."""

from __future__ import annotations

import asyncio
import resource
import selectors
from collections.abc import Coroutine
from typing import Any

_DESCRIPTORS_MAX = 1024  # FD_SETSIZE


def run_on_time(main: Coroutine[Any, Any, None]) -> None:
    """As `asyncio.run`, with timers that are not rounded up to milliseconds, as epoll's time limits are.

    A serial line's bytes pass every 87 us and 2000 frames a second leave every 500 us. What makes it so,
    `select`, takes few descriptors, and this process is held to as many: a testbed has some thirty, and
    further clients wait to be accepted.
    """
    few, many = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(few, _DESCRIPTORS_MAX), many))
    with asyncio.Runner(loop_factory=_new_loop) as runner:
        runner.run(main)


def _new_loop() -> asyncio.AbstractEventLoop:
    return asyncio.SelectorEventLoop(selectors.SelectSelector())
