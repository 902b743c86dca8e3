"""A C program on libmodbus against the D/A mock, over TCP and over a pty."""

import subprocess

import pytest

pytestmark = pytest.mark.peer

SAYS = """\
read: 32768 32768 32768
write all: 0 32768 65535
read: 0 32768 65535
write one: 32768
write and read: 0 11 22
read beyond: Illegal data address
write beyond: Illegal data address
input registers: Illegal function
coils: Illegal function
mask: Illegal function
read: 0 11 22
"""


@pytest.fixture(scope="module")
def client(libmodbus_program):
    return libmodbus_program("libmodbus_client.c")


@pytest.mark.parametrize("wire", ["tcp", "rtu"])
def test_a_libmodbus_client_is_served(client, dac_mock, wire):
    end = str(dac_mock.ends.tcp_port) if wire == "tcp" else dac_mock.ends.pty_path
    command = [client, wire, end]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.stderr == ""
    assert done.stdout == SAYS
    assert done.returncode == 0
