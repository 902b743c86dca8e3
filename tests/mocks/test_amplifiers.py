"""Whichever amplifiers a rig has, the testbed serves them, and they turn its plant's motors."""

import time

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.devices import AMPLIFIERS
from fitctl.mocks.testbed import Testbed as MockTestbed

FREE = {
    "fit-mock": "mocks.loops.right.slcan_port=0",
    "ensemble": "mocks.loops.right.ensemble.tcp_port=0",
    "fit-bal-analog": "mocks.loops.right.bal_analog.modbus_port=0",
}
PORTS = ["gvcp_port", "bench_port", "loops.right.modbus_port", "loops.right.mdt693_port"]


@pytest.mark.parametrize("name", FREE)
def test_a_motor_turns_by_the_wire_that_the_rig_file_names(name, in_loop):
    path = default_rig_path().parent / f"{name}.toml"
    free = [FREE[name], *(f"mocks.{port}=0" for port in PORTS)]
    testbed = MockTestbed(load_rig(path, free), seed=1)
    endpoints = in_loop(testbed.start())
    try:
        where = [f"{key}={value}" for key, value in endpoints.items() if key[:5] == "loops"]
        siderostat = load_rig(path, where).loops["right"].siderostat
        driver = AMPLIFIERS[siderostat.device.driver](siderostat)
        driver.open()
        driver.reset_fault()
        driver.enable()
        end_s = time.monotonic() + 10
        az_rad = 0.0
        while az_rad < 0.5:
            assert time.monotonic() < end_s
            reading = driver.exchange((5.0, 0.0))
            az_rad = reading.position_rad[0] if reading else az_rad
        driver.close()
        live = testbed._siderostats["right"]
        assert live.position_rad()[0] > 0.5
        assert abs(live.position_rad()[1]) < 0.05
    finally:
        in_loop(testbed.stop())
