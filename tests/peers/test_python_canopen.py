"""python-canopen 2.4: its master and its BaseNode402 against our mock drive, by the drive's own data sheet."""

import queue
import time
from importlib.resources import files

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from instruments.mock_bench import ToldMotors

from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.mocks.cia402.drive import Cia402DriveMock

pytestmark = pytest.mark.peer

EDS = str(files("fitctl.mocks.cia402") / "fit_drive.eds")
RPM_RAD_S = 2 * 3.141592653589793 / 60


@pytest.fixture
def motors():
    return ToldMotors()


@pytest.fixture
def mock(in_loop, motors):
    """The mock, and the port that it listens on."""
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat

    async def made():
        mock = Cia402DriveMock(siderostat, motors, port=0)
        mock.port = await mock.start()
        return mock

    mock = in_loop(made())
    yield mock
    in_loop(mock.stop())


@pytest.fixture
def network(mock):
    network = canopen.Network()
    network.connect(
        interface="slcan",
        channel=f"socket://127.0.0.1:{mock.port}",
        bitrate=1000000,
        sleep_after_open=0,
    )
    yield network
    network.disconnect()


@pytest.fixture
def node(network):
    """A heartbeat, and PDO 1 of each direction as BaseNode402 wants them, in service."""
    node = network.add_node(BaseNode402(1, EDS))
    node.sdo["Producer heartbeat time"].raw = 50
    node.nmt.wait_for_heartbeat(timeout=3)
    node.tpdo.read()
    node.rpdo.read()
    for pdo, objects in (
        (node.tpdo[1], ("Statusword azimuth", "Modes of operation display azimuth")),
        (node.rpdo[1], ("Controlword azimuth", "Target velocity azimuth")),
    ):
        pdo.clear()
        for name in objects:
            pdo.add_variable(name)
        pdo.trans_type = 255
        pdo.enabled = True
    node.tpdo[1].event_timer = 20
    node.pdo.save()
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    node.nmt.wait_for_heartbeat(timeout=3)
    return node


def test_base_node_402_walks_the_state_machine_both_ways(node, motors):
    assert node.state == "SWITCH ON DISABLED"
    node.op_mode = "CYCLIC SYNCHRONOUS VELOCITY"
    assert node.op_mode == "CYCLIC SYNCHRONOUS VELOCITY"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    assert motors.enabled == [True, False]
    node.rpdo[1]["Target velocity azimuth"].raw = 60
    node.rpdo[1].transmit()
    assert node.sdo["Target velocity azimuth"].raw == 60
    assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, 0))
    node.state = "SWITCH ON DISABLED"
    assert motors.enabled == [False, False]


def test_base_node_402_comes_out_of_a_fault(node, mock, in_loop):
    fault = Fault(device="right.drive", kind="amplifier_fault", part="az", value=0x7305)

    async def fail():
        mock.faults.set(fault)

    async def mend():
        mock.faults.clear()

    in_loop(fail())
    deadline_s = time.monotonic() + 3
    while not node.emcy.log:
        assert time.monotonic() < deadline_s, "no EMCY"
        time.sleep(0.005)
    assert (node.emcy.log[0].code, node.emcy.log[0].register) == (0x7305, 1)
    while not node.is_faulted():
        node.check_statusword()
    in_loop(mend())
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"


def test_every_readable_object_can_be_read_and_is_what_the_sheet_says(node):
    for item in node.object_dictionary.values():
        parts = [item] if not hasattr(item, "subindices") else item.subindices.values()
        for part in parts:
            if part.readable and (part.index, part.subindex) not in {
                (0x1003, number) for number in range(1, 9)
            }:
                data = node.sdo.upload(part.index, part.subindex)
                assert part.data_type == canopen.objectdictionary.VISIBLE_STRING or (
                    len(data) * 8 == len(part)
                )


def test_texts_and_forced_segments_go_through_its_streams(node):
    assert node.sdo["Manufacturer device name"].raw == "FIT two-axis servo drive (mock)"
    with node.sdo.open(0x60FF, 0, "wb", size=4, force_segment=True) as stream:
        stream.write((1234).to_bytes(4, "little"))
    assert node.sdo[0x60FF].raw == 1234


@pytest.mark.parametrize(
    ("index", "data", "code"),
    [
        (0x2099, b"\0", 0x0602_0000),
        (0x6041, b"\0\0", 0x0601_0002),
        (0x6040, b"\0", 0x0607_0013),
        (0x6060, b"\x08", 0x0609_0030),
    ],
)
def test_aborts_are_the_standards(node, index, data, code):
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        node.sdo.download(index, 0, data)
    assert aborted.value.code == code


def test_a_synchronous_tpdo_answers_each_sync(network, node):
    node.nmt.state = "PRE-OPERATIONAL"
    tpdo = node.tpdo[2]
    tpdo.clear()
    tpdo.add_variable("Position actual value azimuth")
    tpdo.add_variable("Position actual value elevation")
    tpdo.trans_type = 1
    tpdo.enabled = True
    tpdo.save()
    node.nmt.state = "OPERATIONAL"
    received = queue.Queue()
    tpdo.add_callback(lambda _map: received.put(bytes(tpdo.data)))
    for _ in range(5):
        network.sync.transmit()
        assert received.get(timeout=3) == bytes(8)
