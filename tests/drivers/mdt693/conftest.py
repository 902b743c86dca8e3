import pytest
from mdt693_bench import PIEZO, SETTINGS, Bench

from fitctl.mocks.mdt693.server import Mdt693Mock


@pytest.fixture
def start(in_loop):
    """Start a mock; all are stopped at the end."""
    mocks = []

    def started(**changes):
        async def made():
            mock = Mdt693Mock(
                SETTINGS.model_copy(update=changes), PIEZO, lambda volts: None, port=0
            )
            mocks.append(mock)
            return mock, await mock.start()

        return Bench(*in_loop(made()), in_loop)

    yield started
    for mock in mocks:
        in_loop(mock.stop())
