"""`fitctl fault` and `fitctl mocks --faults` as a stranger meets them."""

import json
import subprocess
import sys
import threading
import time

import pytest
import zmq

from fitctl.cli import main
from fitctl.commands.shared.fault_kinds import kinds
from fitctl.config import default_rig_path
from fitctl.mocks.faults import WIRE_FAULTS

SCRIPT = """
[[fault]]
device = "right.mdt693"
kind = "delay"
value = 0.25

[[fault]]
at_s = 3600.0
device = "camera"
kind = "drop"
"""


@pytest.fixture(scope="module")
def mocks(tmp_path_factory):
    """The bench's port of mocks that run with a script."""
    script = tmp_path_factory.mktemp("faults") / "script.toml"
    script.write_text(SCRIPT)
    arguments = ["mocks", "--free-ports", "--json", "--faults", str(script)]
    process = subprocess.Popen(
        [sys.executable, "-m", "fitctl", *arguments], stdout=subprocess.PIPE, text=True
    )
    try:
        yield json.loads(process.stdout.readline())["mocks.bench_port"]
    finally:
        process.terminate()
        process.communicate(timeout=30)


@pytest.fixture
def fault(mocks, capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["fault", *arguments, "--set", f"mocks.bench_port={mocks}"])
        printed = capsys.readouterr()
        return end.value.code or 0, printed.out.strip(), printed.err.strip()

    return run


def test_a_script_makes_things_go_wrong_at_their_time(fault, mocks):
    status, out, err = fault("now")

    assert (status, out) == (0, "right.mdt693 delay 0.25")
    assert err == f"rig fit-mock: {default_rig_path()}, mocks at 127.0.0.1:{mocks}"


@pytest.mark.parametrize("wanted", [["set", "right.dac", "drop"], ["clear"], ["now"]])
def test_the_mocks_of_another_rig_are_left_alone(fault, wanted):
    before = fault("now")[1]

    status, out, err = fault(*wanted, "--set", "name=south")

    assert (status, out) == (2, "")
    assert "are the mocks of rig fit-mock" in err
    assert "of rig south" in err
    assert fault("now")[1] == before


def test_faults_begin_are_listed_and_end(fault):
    shown = "right.drive corrupt for 60 s probability 0.5"
    begun = fault("set", "right.drive", "corrupt", "--for", "60", "--probability", "0.5")
    assert begun[0] == 0
    assert shown in begun[1]
    assert shown in fault("now")[1]
    assert shown not in fault("clear", "right.drive")[1]


def test_a_fault_ends_after_its_time(fault):
    fault("set", "right.dac", "drop", "--for", "0.1")
    deadline_s = time.monotonic() + 5
    while "right.dac" in fault("now")[1]:
        assert time.monotonic() < deadline_s


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["right.mdt693", "melt"], "right.mdt693 has no fault melt; it has drop"),
        (["left.mdt693", "drop"], "no device is named left.mdt693; there are camera, right.drive"),
        (["camera", "drop", "5"], "takes no value"),
        (["camera", "delay", "nan"], "value"),
        (
            ["right.drive", "amplifier_fault", "70000", "--part", "az"],
            "expected 0 to 65535 (error code",
        ),
    ],
)
def test_what_cannot_be_is_one_line_and_status_2(fault, arguments, said):
    status, out, err = fault("set", *arguments)
    assert (status, out) == (2, "")
    which, why = err.splitlines()
    assert which.startswith("rig fit-mock: ")
    assert said in why


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["camera", "dorp"], "camera has no fault dorp; it has drop"),
        (["right.drive", "amplifier_fault", "--part", "ez"], "has no part ez; it has az, el"),
    ],
)
def test_a_fault_that_is_none_is_not_cleared(fault, arguments, said):
    fault("set", "camera", "drop")
    status, out, err = fault("clear", *arguments)
    assert (status, out) == (2, "")
    assert said in err
    assert "camera drop" in fault("now")[1]
    assert fault("clear", "camera", "drop")[0] == 0


@pytest.mark.parametrize(
    ("option", "value"), [("--probability", "2"), ("--for", "-1"), ("--for", "0")]
)
def test_an_option_out_of_its_range_is_named(fault, option, value):
    status, out, err = fault("set", "camera", "drop", option, value)
    assert (status, out) == (2, "")
    assert option in err
    assert err.count("\n") <= 1


def test_without_mocks_it_says_so(capsys):
    with pytest.raises(SystemExit) as end:
        main(["fault", "now", "--set", "mocks.bench_port=0"])
    assert end.value.code == 2
    assert "mocks.bench_port" in capsys.readouterr().err


@pytest.mark.parametrize("reply", [b"\xc1", b"\x81\xa6active\x91\x80"])
def test_another_program_at_the_bench_s_port_is_one_line(capsys, reply):
    with zmq.Context() as context, context.socket(zmq.REP) as other:
        port = other.bind_to_random_port("tcp://127.0.0.1")
        answering = threading.Thread(target=lambda: (other.recv(), other.send(reply)))
        answering.start()
        with pytest.raises(SystemExit) as end:
            main(["fault", "now", "--set", f"mocks.bench_port={port}"])
        answering.join(timeout=10)

    assert end.value.code == 1
    assert (
        f"another program answers at 127.0.0.1:{port}; expected the mocks"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("nonsense", "not TOML"),
        ("[fault]\n", "fault"),
        ("[[faults]]\n", "[[fault]] tables"),
        ('[[fault]]\ndevice = "camera"\nkind = "drop"\nwhen = 1\n', "0.when"),
        ('[[fault]]\ndevice = "camera"\nkind = "melt"\n', "camera has no fault melt"),
        ('[[fault]]\ndevice = "moon"\nkind = "drop"\n', "no device is named moon"),
    ],
)
def test_a_script_with_something_wrong_is_one_line_and_status_2(tmp_path, capsys, script, said):
    path = tmp_path / "script.toml"
    path.write_text(script)
    with pytest.raises(SystemExit) as end:
        main(["mocks", "--free-ports", "--faults", str(path)])
    err = capsys.readouterr().err
    assert end.value.code == 2
    assert len(err.splitlines()) == 1
    assert said in err


@pytest.mark.long
def test_every_device_has_the_faults_of_its_wire(capsys):
    for table in kinds().values():
        assert table.keys() >= WIRE_FAULTS.keys()
    with pytest.raises(SystemExit):
        main(["fault", "kinds"])
    assert "mdt693" in capsys.readouterr().out
