"""The swarm's clock."""

import pytest

from benchmarks.swarm.threads import VirtualTime


@pytest.fixture
def time():
    time = VirtualTime()
    yield time
    time.end()
