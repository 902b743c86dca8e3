import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.modbus_dac.server import ModbusDacMock


@pytest.fixture
def dac_mock(in_loop):
    """The D/A mock, serving; `ends` says where."""
    rig = load_rig(default_rig_path())

    async def start():
        mock = ModbusDacMock(
            rig.loops["right"].fsm.dac,
            rig.mocks.loops["right"].dac.model_copy(update={"watchdog_s": 30.0}),
            lambda volts: None,
            port=0,
        )
        return mock, await mock.start()

    mock, mock.ends = in_loop(start())
    yield mock
    in_loop(mock.stop())
