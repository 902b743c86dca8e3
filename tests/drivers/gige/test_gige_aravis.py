"""The Aravis back end where Aravis is not; with it: tests/peers/gige/test_aravis.py."""

from __future__ import annotations

import sys

import pytest
from gige_served import camera_settings

from fitctl.drivers.gige.aravis import AravisCamera
from fitctl.drivers.interface import DeviceMismatch, DeviceUnreachable


def test_a_missing_library_is_named_and_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)  # importing it fails
    camera = AravisCamera(camera_settings(driver="aravis"))
    with pytest.raises(DeviceUnreachable, match=r"Aravis 0\.8.*gir1\.2-aravis-0\.8.*\"gige\""):
        camera.open()
    camera.close()


def test_the_library_speaks_to_one_port_only() -> None:
    with pytest.raises(DeviceMismatch, match="gvcp_port = 3956, got 4000"):
        AravisCamera(camera_settings(driver="aravis", gvcp_port=4000)).open()


def test_nothing_is_to_be_had_of_a_camera_that_is_not_open() -> None:
    camera = AravisCamera(camera_settings(driver="aravis"))
    for call in (camera.start, lambda: camera.next_frame(0.0)):
        with pytest.raises(DeviceUnreachable, match="open"):
            call()
    camera.stop()
    camera.close()
    assert camera.counts().frames == 0
