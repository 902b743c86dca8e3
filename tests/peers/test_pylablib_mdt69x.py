"""PyPI pylablib 1.4.3, ``Thorlabs.MDT69xA``, against our mock on its pty."""

import time

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.mdt693.server import Mdt693Mock

pytestmark = pytest.mark.peer

RIG = load_rig(default_rig_path())
PIEZO = RIG.loops["right"].fsm.piezo
SETTINGS = RIG.mocks.loops["right"].mdt693.model_copy(
    update={
        "readback_noise_v": 0.0,
        "readback_offset_v": 0.0,
        "readback_settling_s": 0.0,
        "reply_s": 0.005,
    }
)
A = {"model": "MDT693A", "firmware": "3.01"}
B_105 = {"model": "MDT693B", "firmware": "1.05", "prompt": "*"}
B_COMPATIBLE = {"model": "MDT693B", "firmware": "1.10", "prompt": ">", "compatibility_mode": True}


@pytest.fixture(params=[A, B_105, B_COMPATIBLE], ids=["A 3.01", "B 1.05", "B 1.10, cm=1"])
def source(request, in_loop):
    thorlabs = pytest.importorskip(
        "pylablib.devices.Thorlabs", reason="PyPI pylablib-lightweight is not installed"
    )

    async def made():
        mock = Mdt693Mock(
            SETTINGS.model_copy(update=request.param), PIEZO, lambda volts: None, port=0
        )
        return mock, await mock.start()

    mock, ends = in_loop(made())
    mock.set_external_input_v([1.0, 0.0, 2.0])
    source = thorlabs.MDT69xA((ends.pty_path, 115200))
    # It reads one line of the identity; at 115200 baud the others take 17 ms, and it does not wait.
    time.sleep(0.3)
    yield source
    source.close()
    in_loop(mock.stop())


def test_it_opens_and_reads_the_range(source):
    assert source.get_voltage_range() == 150.0


def test_it_reads_what_the_external_inputs_make(source):
    assert source.get_voltage("x") == pytest.approx(15.0, abs=0.1)
    assert source.get_voltage("z") == pytest.approx(30.0, abs=0.1)


def test_what_it_sets_is_added_and_read_back(source):
    source.set_voltage(20.0, "y")
    assert source.get_voltage("y") == pytest.approx(20.0, abs=0.1)
    source.set_voltage(5.0, "x")
    assert source.get_voltage("x") == pytest.approx(20.0, abs=0.1)
