"""PyPI pipython 2.11, the maker's own client, over its plain socket, against our C-887."""

import contextlib
import importlib
import time

import pytest
from instruments.c887_settings import MOCK

from fitctl.mocks.c887.server import C887ControllerMock

pytestmark = pytest.mark.peer

AXES = ["X", "Y", "Z", "U", "V", "W"]


@pytest.fixture
def pipython():
    pytest.importorskip("pipython.pitools", reason="PyPI pipython is not installed")
    return importlib.import_module("pipython")


@pytest.fixture
def mock(in_loop):
    async def made(referenced):
        mock = C887ControllerMock(MOCK.model_copy(update={"referenced": referenced}))
        mock.ends = await mock.start()
        return mock

    mocks = []

    def make(*, referenced=True):
        mocks.append(in_loop(made(referenced)))
        return mocks[-1]

    yield make
    for one in mocks:
        in_loop(one.stop())


@pytest.fixture
def connect(pipython):
    """Connects as pipython's sample connect_socket.py does."""
    from pipython.pidevice.interfaces.pisocket import PISocket

    class Socket(PISocket):
        def close(self):  # which GCSDevice calls again when it is collected
            if self.connected:
                super().close()

    def make(mock):
        gateway = Socket(host="127.0.0.1", port=mock.ends.tcp_port)
        gateway.settimeout(2000)
        return devices.enter_context(pipython.GCSDevice("C-887", gateway=gateway))

    with contextlib.ExitStack() as devices:
        yield make


@pytest.fixture
def device(mock, connect):
    return connect(mock())


def raises(device, number, call, *arguments):
    """The controller's error number arrives as pipython's GCSError."""
    from pipython import GCSError

    with pytest.raises(GCSError) as raised:
        call(*arguments)
    assert raised.value.val == number
    assert device.qERR() == 0, "reading it has cleared it"


def test_it_finds_a_gcs_2_controller_with_six_axes(pipython, device):
    assert isinstance(device.gcsdevice, pipython.GCS2Device)
    assert device.devname == "C-887"
    assert device.qIDN().split(", ")[2:] == ["117040000", "2.3.0.1\n"]
    assert device.qCSV() == 2.0
    assert "2.3.0.1" in device.qVER()
    assert device.axes == device.qSAI() == device.qSAI_ALL() == AXES
    assert device.qCST() == dict.fromkeys(AXES, "M-850.H11")
    assert device.qPUN() == dict(zip(AXES, ["mm"] * 3 + ["deg"] * 3, strict=True))


def test_it_knows_what_the_controller_can_do(device):
    for name in (
        *(
            "MOV",
            "MVR",
            "STP",
            "HLT",
            "FRF",
            "SVO",
            "VLS",
            "SPI",
            "qPOS",
            "qONT",
            "qFRF",
            "qTMN",
            "qTMX",
        ),
        *(
            "qVMO",
            "qSPI",
            "qERR",
            "qHPA",
            "IsMoving",
            "IsControllerReady",
            "StopAll",
            "GetPosStatus",
        ),
        *("GetStatus", "HasPosChanged", "IsRunningMacro", "IsGeneratorRunning"),
    ):
        assert getattr(device, f"Has{name}")(), name
    assert not device.HasINI()
    assert not device.HasEAX()


def test_it_reads_parameters_by_their_types(pipython, device):
    assert device.qSPA("X", 0x3C) == {"X": {0x3C: "M-850.H11"}}
    with pytest.raises(pipython.GCSError) as raised:
        device.qSPA("X", 0x70)
    assert raised.value.val == -7, "a time-out, as for every question that has no answer"
    assert device.qERR() == 54


def test_it_reads_travel_velocity_servo_and_pivot(device):
    assert device.qTMN() == dict(zip(AXES, [-50, -50, -25, -15, -15, -30], strict=True))
    assert device.qTMX("Z") == {"Z": 25.0}
    assert device.qSVO() == dict.fromkeys(AXES, True)
    device.VLS(5.5)
    assert device.qVLS() == 5.5
    device.SPI(["R", "S", "T"], [1.0, 2.0, -3.0])
    assert device.qSPI() == {"R": 1.0, "S": 2.0, "T": -3.0}
    assert device.qSPI("X") == {"X": 1.0}
    assert device.qNLM()["X"] == -50.0
    assert device.qPLM()["W"] == 30.0
    assert device.qSSL() == dict.fromkeys(AXES, True)


def test_a_move_and_waiting_until_it_is_there(pipython, device):
    device.MOV({"X": 1.0, "U": 0.5})
    assert device.IsMoving()["X"]
    assert not device.IsMoving()["Y"]
    assert device.qMOV("X") == {"X": 1.0}
    assert not device.qONT("X")["X"]
    pipython.pitools.waitontarget(device)
    assert device.qONT() == dict.fromkeys(AXES, True)
    assert device.qPOS(["X", "U", "Y"]) == {"X": 1.0, "U": 0.5, "Y": 0.0}
    assert device.GetPosStatus() == device.qPOS()
    assert device.HasPosChanged() == dict.fromkeys(AXES, False)
    device.MVR("X", -0.25)
    pipython.pitools.waitontarget(device)
    assert device.qPOS("X")["X"] == pytest.approx(0.75)
    assert device.GetStatus() & 0x100


def test_moves_during_moves_end_at_the_last_target(pipython, device):
    last_s = time.monotonic() + 0.6
    step = 0
    while time.monotonic() < last_s:
        step += 1
        device.MOV("Y", 0.01 * step)
    pipython.pitools.waitontarget(device)
    assert device.qPOS("Y")["Y"] == pytest.approx(0.01 * step)
    device.MOV("Y", 5.0)
    device.MVR("Y", -4.0)  # of the target, not of where it is
    pipython.pitools.waitontarget(device, "Y")
    assert device.qPOS("Y")["Y"] == pytest.approx(1.0)


def test_referencing_as_pitools_does_it(pipython, mock, connect):
    device = connect(mock(referenced=False))
    assert device.qFRF() == dict.fromkeys(AXES, False)
    raises(device, 5, device.MOV, "X", 1.0)
    device.FRF("X")
    assert not device.IsControllerReady()
    pipython.pitools.waitonreferencing(device)
    assert device.IsControllerReady()
    assert device.qFRF() == dict.fromkeys(AXES, True)
    device.MOV("X", 0.1)
    pipython.pitools.waitontarget(device)


def test_startup_as_pitools_does_it(pipython, mock, connect):
    device = connect(mock(referenced=False))
    pipython.pitools.startup(device, refmodes="FRF")
    assert device.qFRF() == device.qSVO() == dict.fromkeys(AXES, True)


def test_errors_are_the_product_s_numbers(device):
    raises(device, 7, device.MOV, "X", 50.1)
    raises(device, 7, device.MOV, {"X": 40.0, "Y": 40.0})
    raises(device, 15, device.MOV, "Q", 1.0)
    raises(device, 1, device.MOV, "X", "far")
    raises(device, 2, device.JOG, "X", 1.0)
    raises(device, 8, device.VLS, 8.1)
    device.SVO(AXES, [False] * 6)
    raises(device, 5, device.MOV, "X", 1.0)
    raises(device, 5, device.FRF)
    device.SVO(AXES, [True] * 6)
    device.MOV("W", 1.0)
    raises(device, 93, device.VLS, 4.0)
    while device.IsMoving()["W"]:
        pass
    raises(device, 9, device.SPI, "R", 1.0)
    assert device.qPOS("X")["X"] == 0.0, "none of them moved it"


def test_a_pose_is_tried_out_before_it_is_approached(device):
    assert device.qVMO({"X": 50.0})
    assert not device.qVMO({"X": 50.0, "Y": 1.0}), "the travel of one axis depends on the others"
    assert not device.qVMO({"Z": 25.1})
    assert device.qVMO({"X": 30.0, "Y": 30.0})


@pytest.mark.parametrize("how", ["StopAll", "STP", "HLT"])
def test_a_stop_leaves_it_where_it_is(device, how):
    device.MOV("X", 20.0)
    time.sleep(0.3)
    raises(device, 10, getattr(device, how))
    time.sleep(0.1)
    assert not any(device.IsMoving().values())
    here = device.qPOS("X")["X"]
    assert 0.5 < here < 5.0
    assert device.qMOV("X")["X"] == pytest.approx(here, abs=1e-6)
    getattr(device, how)(noraise=True)


def test_a_stop_ends_a_reference_move(mock, connect):
    device = connect(mock(referenced=False))
    device.FRF()
    device.StopAll(noraise=True)
    assert device.IsControllerReady()
    assert not any(device.qFRF().values())


def test_two_clients_at_once(mock, connect):
    controller = mock()
    one, other = connect(controller), connect(controller)
    one.MOV("X", 10.0)
    assert other.IsMoving()["X"]
    other.StopAll(noraise=True)
    time.sleep(0.1)
    assert not one.IsMoving()["X"]
    raises(one, 5, _move_unreferenced, one, controller)


def _move_unreferenced(device, controller):
    controller.platform.referenced = False
    device.MOV("X", 0.0)


def test_it_speaks_over_the_serial_port(pipython, mock):
    from pipython.pidevice.interfaces.piserial import PISerial

    with PISerial(port=mock().ends.pty_path, baudrate=115200) as gateway:
        device = pipython.GCSDevice("C-887", gateway=gateway)
        assert device.qSAI() == AXES
        device.MOV("X", 0.1)
        pipython.pitools.waitontarget(device)
        assert device.qPOS("X") == {"X": pytest.approx(0.1)}
