"""A serial port that another process has: no driver sends a byte to it."""

import fcntl
import os
import pty
import select
import socket

import pytest

from fitctl import config
from fitctl.commissioning.asking import PROBES
from fitctl.drivers.interface import DeviceError, DeviceUnreachable

RIGS = config.default_rig_path().parent
LOOP = "loops.right"
ON_SERIAL_PORTS = {
    "cia402": (
        "fit-mock",
        f"{LOOP}.siderostat.device",
        {"interface": "slcan", "channel": "{port}"},
    ),
    "ensemble": ("ensemble", f"{LOOP}.siderostat.device", {"port": "{port}"}),
    "modbus_dac": ("fit-mock", f"{LOOP}.fsm.dac", {"transport": "rtu", "serial_port": "{port}"}),
    "mdt693": ("fit-mock", f"{LOOP}.fsm.piezo", {"port": "{port}"}),
    "c887": ("fit-testbed", "collector.hexapod", {"port": "{port}"}),
}


def settings_of(driver, port):
    file, table, keys = ON_SERIAL_PORTS[driver]
    overrides = [f"{table}.{key}={value.format(port=port)}" for key, value in keys.items()]
    rig = config.load_rig(RIGS / f"{file}.toml", overrides)
    loop = rig.stellar_loops["right"]
    settings = {"modbus_dac": loop.fsm.dac, "mdt693": loop.fsm.piezo}
    if rig.collector is not None:
        settings["c887"] = rig.collector.hexapod
    return settings.get(driver, loop.siderostat)


@pytest.mark.parametrize("driver", ON_SERIAL_PORTS)
def test_a_port_in_use_gets_no_byte(driver):
    master, slave = pty.openpty()
    try:
        fcntl.flock(slave, fcntl.LOCK_EX)
        with pytest.raises(DeviceUnreachable):
            PROBES[driver](settings_of(driver, os.ttyname(slave)))
        assert not select.select([master], [], [], 0.05)[0], os.read(master, 100)
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize("driver", ON_SERIAL_PORTS)
def test_a_port_that_is_free_again_is_asked(driver):
    master, slave = pty.openpty()
    try:
        settings = settings_of(driver, os.ttyname(slave))
        for _ in range(2):
            with pytest.raises(DeviceError):
                PROBES[driver](settings)
            assert os.read(master, 100)
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize("driver", ["mdt693", "c887"])
def test_an_address_where_nothing_listens_says_what_serves_it(driver):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]

    with pytest.raises(DeviceUnreachable, match=r"start what serves it \(mocks: fitctl mocks\)"):
        PROBES[driver](settings_of(driver, f"socket://127.0.0.1:{port}"))
