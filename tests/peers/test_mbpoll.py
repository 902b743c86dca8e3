"""mbpoll, a Modbus master for the shell, against the D/A mock: TCP, its pty, and a socat pair of ptys."""

import re
import shutil
import subprocess
import time

import pytest

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("mbpoll") is None, reason="mbpoll is not installed: Debian package mbpoll"
    ),
]


@pytest.fixture
def socat_pty(dac_mock, tmp_path):
    """One end of a socat pair whose other end is the mock's pty."""
    if shutil.which("socat") is None:
        pytest.skip("socat is not installed: Debian package socat")
    link = tmp_path / "line"
    raw = "raw,echo=0,b115200"
    process = subprocess.Popen(
        ["socat", f"PTY,link={link},{raw}", f"{dac_mock.ends.pty_path},{raw}"]
    )
    end_s = time.monotonic() + 10
    while not link.exists() and time.monotonic() < end_s:
        time.sleep(0.01)
    yield str(link)
    process.terminate()
    process.wait(10)


@pytest.fixture(params=["tcp", "rtu", "rtu by socat"])
def mbpoll(request, dac_mock):
    """Run mbpoll once on three registers from 0 on, or as told; gives status and output."""
    if request.param == "tcp":
        wire = ["-m", "tcp", "-p", str(dac_mock.ends.tcp_port), "127.0.0.1"]
    else:
        by_socat = request.param == "rtu by socat"
        port = request.getfixturevalue("socat_pty") if by_socat else dac_mock.ends.pty_path
        wire = ["-m", "rtu", "-b", "115200", "-P", "none", "-s", "2", port]

    def run(*arguments, values=()):
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


def read(output):
    return [int(value) for value in re.findall(r"^\[\d\]:\s+(\d+)", output, re.MULTILINE)]


def test_what_it_writes_is_put_out_and_read_back(mbpoll, dac_mock):
    status, output = mbpoll("-r", "0", values=[0, 32768, 65535])
    assert (status, "Written 3 references" in output) == (0, True), output
    assert dac_mock.outputs_v == pytest.approx([0, 5, 10], abs=1e-4)
    status, output = mbpoll("-r", "0", "-c", "3")
    # mbpoll shows values from 32768 on as signed too, in parentheses.
    assert (status, read(output)) == (0, [0, 32768, 65535]), output


def test_it_writes_one_register(mbpoll, dac_mock):
    status, output = mbpoll("-r", "2", values=[0])
    assert status == 0, output
    assert dac_mock.outputs_v == pytest.approx([5, 5, 0], abs=1e-4)


def test_it_hears_of_an_illegal_address_and_an_illegal_function(mbpoll):
    _, output = mbpoll("-r", "3", "-c", "1")
    assert "Illegal data address" in output
    _, output = mbpoll("-t", "3", "-r", "0", "-c", "1")
    assert "Illegal function" in output


def test_another_unit_is_no_target_over_tcp_and_silent_over_rtu(mbpoll):
    _, output = mbpoll("-a", "9", "-r", "0", "-c", "1")
    assert "Target device failed to respond" in output or "Connection timed out" in output
