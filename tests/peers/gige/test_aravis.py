"""Aravis against our mock camera and our driver against Aravis' fake camera, in a network of their own.

Checked with Aravis 0.8.26 of Debian 12 and tshark 4.0.17.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from gige_alone import image

pytestmark = pytest.mark.peer

HERE = Path(__file__).parent
SYSTEM_PYTHON = "/usr/bin/python3"
CAMERA = "FIT-MockCamera-FIT01"
ALONE = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--map-root-user", "--net"]
HAS_BINDING = "import gi; gi.require_version('Aravis', '0.8'); from gi.repository import Aravis"


def works(*command: str) -> bool:
    if shutil.which(command[0]) is None:
        return False
    done = subprocess.run(command, capture_output=True, timeout=30, check=False)
    return done.returncode == 0


@pytest.fixture(scope="module", autouse=True)
def _a_network_of_its_own() -> None:
    if not works(*ALONE, "ip", "link", "set", "lo", "up"):
        pytest.skip("needs unshare and ip, and leave to make a network namespace")


def needs(program: str) -> str:
    if shutil.which(program) is None:
        pytest.skip(
            f"{program} is not installed: Debian has aravis-tools, aravis-tools-cli, tshark"
        )
    return program


def alone(*command: str, **order) -> str:
    """What a command says beside a mock camera in an otherwise empty network."""
    asked = json.dumps({"command": command, **order})
    done = subprocess.run(
        [*ALONE, sys.executable, str(HERE / "gige_alone.py"), asked],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def camera_test(*options: str, **order) -> dict[str, int]:
    """The counts that arv-camera-test prints at its end."""
    program = needs("arv-camera-test-0.8")
    said = alone(program, "-n", CAMERA, "-i", "1500", "--duration", "2", *options, **order)
    lines = [line.split("=") for line in said.splitlines() if line.startswith("n_")]
    return {name.strip(): int(value) for name, value in lines}


def python_with_the_binding() -> str:
    if not works(SYSTEM_PYTHON, "-c", HAS_BINDING):
        pytest.skip("the system's Python has no Aravis: Debian has gir1.2-aravis-0.8, python3-gi")
    return SYSTEM_PYTHON


# ---------------------------------------------------------------- Aravis on our mock


def test_aravis_discovers_the_mock_by_broadcast() -> None:
    assert alone(needs("arv-tool-0.8")).strip() == f"{CAMERA} (127.0.0.1)"


def test_every_feature_of_the_description_can_be_read() -> None:
    values = alone(needs("arv-tool-0.8"), "-n", CAMERA, "values")
    assert "'PixelFormat' = 'Mono16'" in values
    assert "'Gain' = 0 dB" in values
    assert "rror" not in values


def test_a_stream_runs_without_loss() -> None:
    counts = camera_test("-w", "40", "-h", "40", "-f", "50", "-e", "10000", "-g", "3")
    assert counts["n_completed_buffers"] > 80
    assert counts["n_failures"] == counts["n_missing_packets"] == counts["n_error_packets"] == 0
    assert counts["n_resend_requests"] == counts["n_ignored_packets"] == 0


def test_lost_packets_are_asked_for_and_sent_again() -> None:
    loss = [{"kind": "packet_loss", "probability": 0.03}]
    counts = camera_test("-f", "50", "-q", "2.0", faults=loss)
    assert counts["n_completed_buffers"] > 70
    assert counts["n_resent_packets"] > 0
    assert counts["n_missing_packets"] < counts["n_resend_requests"]


def test_a_delay_between_packets_is_taken() -> None:
    counts = camera_test("-f", "20", "-y", "2000000")
    assert counts["n_completed_buffers"] > 25
    assert counts["n_missing_packets"] == 0


def test_frames_come_by_software_trigger() -> None:
    counts = camera_test("-o", "10")
    assert 10 < counts["n_completed_buffers"] < 25


def test_the_python_binding_gets_what_the_features_say() -> None:
    found = json.loads(alone(python_with_the_binding(), str(HERE / "aravis_client.py")))
    assert found["devices"] == [CAMERA]
    assert found["controls"]
    assert found["formats"] == ["Mono8", "Mono12", "Mono16"]
    assert found["temperature_c"] == pytest.approx(31.5)
    assert 0 < found["ticks"][0] < found["ticks"][1]
    assert found["settings"] == pytest.approx([6.0206, 2000.0, 100.0])
    expected = 2 * image()[4:16, 8:24].astype(int)  # 6 dB is twice
    for name, bits in (("Mono8", 8), ("Mono12", 12), ("Mono16", 16)):
        data = bytes(found["images"][name])
        pixels = memoryview(data).cast("B" if bits == 8 else "H").tolist()
        wanted = (expected.clip(0, 65535) >> (16 - bits)).ravel().tolist()
        assert pixels == pytest.approx(wanted, abs=1)
    assert (found["untriggered"], found["triggered"]) == (False, True)
    assert "invalid-parameter" in found["refused"]


# ---------------------------------------------------------------- our driver on Aravis' camera


def ours(*settings: str, **order) -> dict:
    script = str(HERE / "gige_ours.py")
    return json.loads(alone(sys.executable, script, *settings, **order))


def fake_camera(*options: str) -> list[str]:
    return [needs("arv-fake-gv-camera-0.8"), "-i", "127.0.0.1", "-s", "FIT01", *options]


SIZE = ("camera.width_px=128", "camera.height_px=128")


# Of a star that fits into a pixel of 8 bits.
DARKER = ("camera.bias_dn=10", "camera.pixel_noise_dn=1", "loops.right.star_flux_dn=900")


@pytest.mark.parametrize(("pixel_format", "settings"), [("Mono8", DARKER), ("Mono16", ())])
def test_the_driver_takes_aravis_camera_by_its_own_description(
    pixel_format: str, settings: tuple[str, ...]
) -> None:
    setting = f"camera.device.pixel_format={pixel_format}"
    found = ours(*SIZE, setting, *settings, mock=False, beside=fake_camera())
    assert found["identity"] == ["Aravis", "Fake", "FIT01"]
    assert found["discovered"] == "FIT01"
    assert (found["frames"], found["lost"], found["shape"]) == (100, 0, [128, 128])
    assert "DeviceTimeout" in found["second"]  # this camera does not refuse others, it ignores them


def test_packets_that_aravis_camera_loses_and_cannot_resend_are_counted() -> None:
    found = ours(*SIZE, mock=False, beside=fake_camera("-r", "5"))
    assert found["frames"] == 100
    assert found["packets_lost"] > 0
    assert 0 < found["lost"] < 100
    assert found["numbers"][-1] == 100 + found["lost"]


# ---------------------------------------------------------------- Aravis as our back end


def back_end(script: str, **order) -> dict:
    python = python_with_the_binding()
    packages = [sysconfig.get_path("purelib"), str(HERE.parents[2])]
    environment = ["env", f"PYTHONPATH={os.pathsep.join(packages)}", python]
    if not works(*environment, "-c", "import fitctl.drivers.gige.driver, fitctl.config"):
        pytest.skip("the system's Python cannot use this environment's packages")
    return json.loads(alone(*environment, str(HERE / script), **order))


def test_the_back_end_gives_the_same_frames() -> None:
    found = back_end("aravis_back_end.py")
    assert found["model"] == "MockCamera"
    assert found["numbers"] == list(range(1, 51))
    assert found["same"]
    assert min(found["ages_s"]) >= 0.034
    assert (found["lost"], found["packets_lost"]) == (0, 0)
    assert found["slower_s"] == pytest.approx([0.04] * 4, rel=0.02)
    assert "expected frame rate = 1e+06, got 100" in found["too fast"]
    assert "control of the camera" in found["AravisCamera"]
    assert "control of the camera" in found["GigeCamera"]
    assert "Width" in found["wide"]


def test_the_back_end_counts_what_is_lost() -> None:
    loss = [{"kind": "packet_loss", "probability": 0.02}]
    found = back_end("aravis_back_end.py", faults=loss)
    assert found["same"]
    assert found["packets_lost"] > 0
    assert found["numbers"][-1] == 50 + found["lost"]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"kind": "freeze", "at_s": 4.0}, "to be readable"),
        ({"kind": "reboot", "at_s": 4.0, "value": 0.2}, "a camera that has ended it"),
    ],
)
def test_the_back_end_notices_that_the_camera_is_lost(fault: dict, said: str) -> None:
    found = back_end("aravis_lost.py", faults=[fault])
    assert found["frames"] > 10
    assert "DeviceUnreachable" in found["error"]
    assert said in found["error"]
    assert found["after_s"] < 10
    assert found["closed"]


# ---------------------------------------------------------------- tshark on both


def dissected(capture: Path) -> list[str]:
    """Everything that tshark has to complain of."""
    program = needs("tshark")
    shown = "_ws.malformed || _ws.expert.severity >= 0x600000"  # warnings and errors
    reading = [program, "-r", str(capture), "--enable-heuristic", "gvsp_udp", "-Y", shown]
    done = subprocess.run(reading, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.splitlines()


def protocols(capture: Path) -> dict[str, int]:
    """How many packets tshark takes for GVCP and GVSP."""
    reading = ["tshark", "-r", str(capture), "--enable-heuristic", "gvsp_udp"]
    counted = {}
    for name in ("gvcp", "gvsp"):
        done = subprocess.run(
            [*reading, "-Y", name], capture_output=True, text=True, timeout=60, check=True
        )
        counted[name] = len(done.stdout.splitlines())
    return counted


def test_tshark_finds_nothing_wrong_with_aravis_and_the_mock(tmp_path: Path) -> None:
    needs("tshark")
    capture = tmp_path / "aravis.pcapng"
    loss = [{"kind": "packet_loss", "probability": 0.03}]
    camera_test("-f", "50", "-q", "2.0", capture=str(capture), faults=loss)
    counted = protocols(capture)
    assert counted["gvcp"] > 50
    assert counted["gvsp"] > 300
    assert dissected(capture) == []


def test_tshark_finds_nothing_wrong_with_our_driver_and_the_mock(tmp_path: Path) -> None:
    needs("tshark")
    capture = tmp_path / "ours.pcapng"
    loss = [{"kind": "packet_loss", "probability": 0.03}]
    found = ours(capture=str(capture), faults=loss)
    assert "0x8006 ACCESS_DENIED" in found["second"]  # a refusal is in the capture
    counted = protocols(capture)
    assert counted["gvcp"] > 50
    assert counted["gvsp"] > 300
    assert dissected(capture) == []
