import asyncio
import threading

import pytest


@pytest.fixture
def in_loop():
    """Run a coroutine in an event loop of another thread, as the testbed's process would."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield lambda coroutine: asyncio.run_coroutine_threadsafe(coroutine, loop).result(10)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)
    left = asyncio.all_tasks(loop)
    loop.close()
    assert not left
