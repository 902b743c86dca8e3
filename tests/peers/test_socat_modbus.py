"""The D/A driver on RTU behind a terminal server: socat, between a TCP port and the mock's pty."""

import shutil
import socket
import subprocess

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.modbus_dac.driver import ModbusDac

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("socat") is None, reason="socat is not installed: Debian package socat"
    ),
]


@pytest.fixture
def terminal_server(dac_mock):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    line = f"{dac_mock.ends.pty_path},raw,echo=0,b115200"
    listen = f"TCP-LISTEN:{port},bind=127.0.0.1"
    # With -d -d it says on stderr when it listens.
    process = subprocess.Popen(
        ["socat", "-d", "-d", listen, line], stderr=subprocess.PIPE, text=True
    )
    assert "listening" in process.stderr.readline()
    yield f"socket://127.0.0.1:{port}"
    process.terminate()
    process.wait(10)
    process.stderr.close()


def test_it_writes_and_reads_back(terminal_server, dac_mock):
    settings = (
        load_rig(default_rig_path())
        .loops["right"]
        .fsm.dac.model_copy(update={"transport": "rtu", "serial_port": terminal_server})
    )
    dac = ModbusDac(settings)
    assert dac.open().model == "mock D/A"
    volts = np.array([1.0, 2.0, 3.0])
    dac.send_v(volts)
    dac.confirm()
    assert dac_mock.outputs_v == pytest.approx(volts, abs=1e-4)
    assert dac.read_v() == pytest.approx(volts, abs=1e-4)
    dac.close()
