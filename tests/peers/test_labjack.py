"""Other people's Modbus clients against the LabJack T7 mock: mbpoll, libmodbus, pymodbus' own client."""

import re
import shutil
import subprocess

import pytest
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient

pytestmark = pytest.mark.peer

SAYS = """\
PRODUCT_ID: 7.00
AIN0 to AIN3, 03: 5.00 4.00 3.00 0.25
AIN0 to AIN3, 04: 5.00 4.00 3.00 0.25
SERIAL_NUMBER: 470012345
AIN_ALL_RANGE = 1: done
AIN_ALL_RANGE: 1.00
AIN_ALL_RESOLUTION_INDEX = 3: done
AIN_ALL_SETTLING_US = 100: done
AIN_ALL_RESOLUTION_INDEX: 3
AIN0 to AIN3, 1 V: 1.01 1.01 1.01 0.25
AIN_ALL_RESOLUTION_INDEX = 9: Illegal data value
LAST_ERR_DETAIL: 2375
AIN0 = 1: Illegal data address
AIN14: Illegal data address
half of AIN0: Illegal data value
coil: Illegal function
function 23: Illegal function
"""


def test_a_libmodbus_client_reads_and_sets_it(libmodbus_program, labjack):
    labjack.volts[3] = 0.25
    command = [libmodbus_program("libmodbus_labjack.c"), str(labjack.port)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == SAYS


# ---------------------------------------------------------------- mbpoll


@pytest.fixture
def mbpoll(labjack):
    """Run mbpoll once; gives status and output."""
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll is not installed: Debian package mbpoll")

    def run(*arguments, values=()):
        wire = ["-m", "tcp", "-p", str(labjack.port), "127.0.0.1"]
        done = subprocess.run(
            ["mbpoll", "-0", "-1", "-o", "2", *arguments, *wire, *map(str, values)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=30,
            check=False,
        )
        return done.returncode, done.stdout

    return run


def shown(output):
    return [float(value) for value in re.findall(r"^\[\d+\]:\s+(\S+)", output, re.MULTILINE)]


@pytest.mark.parametrize("kind", ["4:float", "3:float"], ids=["holding, 03", "input, 04"])
def test_mbpoll_reads_all_four_inputs_as_big_endian_floats(mbpoll, labjack, kind):
    labjack.volts[:] = [5.0, -4.0, 0.125, 9.5]
    status, output = mbpoll("-t", kind, "-B", "-r", "0", "-c", "4")
    assert status == 0, output
    assert shown(output) == pytest.approx([5.0, -4.0, 0.125, 9.5], abs=1e-3)


def test_mbpoll_reads_the_product_and_the_serial_number(mbpoll):
    _, output = mbpoll("-t", "4:float", "-B", "-r", "60000", "-c", "1")
    assert shown(output) == [7.0], output
    _, output = mbpoll("-t", "4:int", "-B", "-r", "60028", "-c", "1")
    assert shown(output) == [470012345], output


def test_mbpoll_sets_the_range_and_hears_of_what_it_cannot_be(mbpoll, labjack):
    status, output = mbpoll("-t", "4:float", "-B", "-r", "43900", values=["0.1"])
    assert status == 0, output
    labjack.volts[:] = [0.05, 1.0, 1.0, 1.0]
    _, output = mbpoll("-t", "4:float", "-B", "-r", "0", "-c", "2")
    assert shown(output) == pytest.approx([0.05, 0.101], abs=1e-4), output
    _, output = mbpoll("-t", "4:float", "-B", "-r", "43900", values=["5.0"])
    assert "Illegal data value" in output
    _, output = mbpoll("-t", "4", "-r", "28", "-c", "1")
    assert "Illegal data address" in output
    _, output = mbpoll("-t", "1", "-r", "0", "-c", "1")
    assert "Illegal function" in output


# ---------------------------------------------------------------- pymodbus


def test_pymodbus_own_client_reads_and_sets_it(labjack):
    client = ModbusTcpClient("127.0.0.1", port=labjack.port, timeout=5)
    assert client.connect()
    kind = client.DATATYPE.FLOAT32
    for read in (client.read_holding_registers, client.read_input_registers):
        volts = client.convert_from_registers(read(0, count=8).registers, kind)
        assert volts == pytest.approx([5.0, 4.0, 3.0, 2.0], abs=1e-3)
    assert not client.write_registers(43900, client.convert_to_registers(10.0, kind)).isError()
    answer = client.read_holding_registers(43900, count=2)
    assert client.convert_from_registers(answer.registers, kind) == 10.0
    assert client.write_registers(43900, client.convert_to_registers(3.0, kind)).exception_code == 3
    assert client.read_holding_registers(28, count=2).exception_code == 2
    assert client.read_coils(0).exception_code == 1
    client.close()


def test_pymodbus_asynchronous_client_is_answered_in_turn(labjack, in_loop):
    async def ask():
        client = AsyncModbusTcpClient("127.0.0.1", port=labjack.port, timeout=5)
        assert await client.connect()
        answers = [await client.read_holding_registers(0, count=8) for _ in range(20)]
        client.close()
        return [
            client.convert_from_registers(one.registers, client.DATATYPE.FLOAT32) for one in answers
        ]

    for volts in in_loop(ask()):
        assert volts == pytest.approx([5.0, 4.0, 3.0, 2.0], abs=1e-3)
