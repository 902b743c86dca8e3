"""The systemd unit: understood by systemd, and it says what the documents say of it."""

import configparser
import re
import shutil
import subprocess
import sys

import pytest
from documents import ROOT

from fitctl.cli import UNUSABLE

UNIT = ROOT / "systemd" / "fitctl@.service"
SERVO_PRIORITY = 60


def read_unit():
    """Its sections; a key that comes several times keeps its last value."""
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str
    parser.read(UNIT)
    return parser


def verified(folder, text):
    """What systemd says of a unit whose fitctl is this one."""
    (folder / "fitctl@.service").write_text(text.replace("/opt/fitctl/bin/fitctl", sys.executable))
    (folder / "fitctl@night.service").symlink_to(folder / "fitctl@.service")
    return subprocess.run(
        ["systemd-analyze", "verify", folder / "fitctl@night.service"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd-analyze")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    done = verified(tmp_path, UNIT.read_text())

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd-analyze")
def test_systemd_would_say_what_is_wrong(tmp_path):
    done = verified(tmp_path, UNIT.read_text().replace("LimitRTPRIO", "LimitRealtime"))

    assert "LimitRealtime" in done.stderr


def test_the_unit_grants_what_the_supervisor_asks_for():
    service = read_unit()["Service"]

    assert int(service["LimitRTPRIO"]) >= SERVO_PRIORITY
    assert service["LimitMEMLOCK"] == "infinity"
    assert service["RestrictRealtime"] == "no"
    assert {"AF_UNIX", "AF_INET", "AF_CAN"} <= set(service["RestrictAddressFamilies"].split())
    assert int(service["RestartPreventExitStatus"]) == UNUSABLE


def test_its_sockets_are_for_their_owner_in_the_folder_that_systemd_makes():
    service = read_unit()["Service"]

    assert service["RuntimeDirectoryMode"] == "0700"
    assert f"service.folder=/run/{service['RuntimeDirectory']}" in service["ExecStart"]


def test_every_line_that_the_document_explains_is_in_the_unit():
    page = (ROOT / "docs" / "running-as-a-service.md").read_text()
    explained = page.split("### What the unit sets, and why")[1]
    lines = re.findall(
        r"`([A-Z]\w+=[^`…]*)…?`", explained.split("To change a setting for your site")[0]
    )
    text = UNIT.read_text()

    assert len(lines) > 8
    missing = [line for line in lines if not re.search(rf"^{re.escape(line)}", text, re.MULTILINE)]
    assert missing == ["DeviceAllow=/dev/pcan0 rw"]  # the site's own
