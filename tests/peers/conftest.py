import shutil
import subprocess
from pathlib import Path

import pytest
from instruments.labjack_bench import Bench

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


@pytest.fixture
def labjack(in_loop):
    """A LabJack T7 mock with its voltages, serving at `port`."""

    async def start():
        bench = Bench(overhead_s=0.001)
        bench.port = await bench.mock.start()
        return bench

    bench = in_loop(start())
    yield bench
    in_loop(bench.mock.stop())


@pytest.fixture(scope="session")
def libmodbus_program(tmp_path_factory):
    """Compiles a C file of this folder with libmodbus; gives the program."""

    def compiled(name):
        compiler = shutil.which("cc")
        if compiler is None or shutil.which("pkg-config") is None:
            pytest.skip("no C compiler named cc, or no pkg-config")
        flags = ["pkg-config", "--cflags", "--libs", "libmodbus"]
        found = subprocess.run(flags, capture_output=True, text=True, check=False)
        if found.returncode:
            pytest.skip("libmodbus is not installed: Debian package libmodbus-dev")
        program = tmp_path_factory.mktemp("libmodbus") / "client"
        source = Path(__file__).with_name(name)
        command = [compiler, "-Wall", "-Werror", str(source), "-o", str(program)]
        subprocess.run([*command, *found.stdout.split()], check=True)
        return program

    return compiled
