"""A camera asked by `fitctl doctor`: what it says of the rig file, and that asking changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from gige_served import IMAGE, Served, camera_settings, mock_settings
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import Camera
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.gige.probe import probe_camera
from fitctl.drivers.gige.protocol import Command
from fitctl.drivers.interface import DeviceError
from fitctl.mocks.gige import memory

Serve = Callable[..., Served]


@pytest.fixture
def describe(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Have cameras started from now on describe themselves otherwise."""

    def change(old: str, new: str) -> None:
        name = "fit_camera.xml"
        xml = Path(memory.__file__).with_name(name).read_text()
        assert old in xml
        changed = xml.replace(old, new).encode()
        monkeypatch.setattr(memory, "_description", lambda _: (name, changed))

    return change


def told(served: Served, **changes: Any) -> tuple[str, ...]:
    return probe_camera(camera_settings(gvcp_port=served.port, **changes)).disagreements


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({}, ()),
        ({"width_px": 48}, ("Width: camera.width_px is 48, the camera takes 8 to 40; set",)),
        ({"height_px": 41}, ("Height: camera.height_px is 41, the camera takes 8 to 40; set",)),
        ({"gain": 30.0}, ("Gain: camera.device.gain is 30, the camera takes 0 to 24; set",)),
        (
            {"packet_size_bytes": 1501},
            ("GevSCPSPacketSize: camera.device.packet_size_bytes is 1501, the camera takes 576",),
        ),
        ({"width_px": 48, "gain": 30.0}, ("Width: ", "Gain: ")),
    ],
)
def test_each_setting_outside_the_cameras_own_limits_is_told(
    serve: Serve, changes: dict[str, Any], what: tuple[str, ...]
) -> None:
    lines = told(serve(), **changes)
    assert [line[: len(start)] for line, start in zip(lines, what, strict=True)] == list(what)


@pytest.mark.parametrize(
    ("old", "new", "changes", "what"),
    [
        (
            '<EnumEntry Name="Mono12" NameSpace="Standard"><Value>0x01100005',
            '<EnumEntry Name="Mono12Packed" NameSpace="Standard"><Value>0x010C0006',
            {"pixel_format": "Mono12"},
            "camera.device.pixel_format is Mono12, the camera has Mono8, Mono12Packed, Mono16",
        ),
        (
            '"Mono12" NameSpace="Standard"><Value>0x01100005</Value>',
            '"Mono12" NameSpace="Standard"><pIsAvailable>TLParamsLocked</pIsAvailable>'
            "<Value>0x01100005</Value>",
            {"pixel_format": "Mono12"},
            "camera.device.pixel_format is Mono12, the camera has Mono8, Mono16",
        ),
        (
            "<pMax>WidthMost</pMax><Inc>1</Inc>",
            "<pMax>WidthMost</pMax><Inc>12</Inc>",
            {},
            "Width: camera.width_px is 40, the camera takes 8 to 40 in steps of 12",
        ),
        (
            "<pMax>FrameRateMost</pMax>",
            "<Max>30.0</Max>",
            {},
            "AcquisitionFrameRate: camera.frame_rate_hz is 50, the camera takes 1 to 30;",
        ),
        (
            "<Min>1.0</Min><pMax>ExposureTimeMost</pMax>",
            "<Min>20000.0</Min><pMax>ExposureTimeMost</pMax>",
            {},
            "ExposureTime: camera.exposure_s is 0.01, the camera takes 0.02 to 0.04;",
        ),
        (
            "AcquisitionFrameRate",
            "VendorFrameRate",
            {},
            "AcquisitionFrameRate: the camera has no such feature, for camera.frame_rate_hz",
        ),
        (
            "Gain",
            "VendorGain",
            {"gain": 3.0},
            "Gain: the camera has no such feature, for camera.device.gain",
        ),
        ("<RegisterDescription", "<NoDescription", {}, "expected a GenICam description"),
    ],
)
def test_what_the_cameras_description_says_counts(
    serve: Serve, describe: Callable[[str, str], None], old: str, new: str, changes: Any, what: str
) -> None:
    describe(old, new)
    (line,) = told(serve(), **changes)
    assert what in line


@pytest.fixture(scope="module")
def shared() -> Iterator[Served]:
    """One camera for many examples: each finds it as the last one left it."""
    served = Served(camera_settings(), mock_settings(), lambda _: IMAGE)
    yield served
    served.close()


@st.composite
def asked(draw: st.DrawFn) -> dict[str, Any]:
    rate_hz = draw(st.floats(1, 2000))
    return {
        "width_px": draw(st.integers(16, 44)),
        "height_px": draw(st.integers(16, 44)),
        "frame_rate_hz": rate_hz,
        "exposure_s": draw(st.floats(0.01, 0.99)) / rate_hz,
        "gain": draw(st.floats(0, 26)),
        "pixel_format": draw(st.sampled_from(sorted(protocol.PIXEL_FORMATS))),
        "packet_size_bytes": draw(st.integers(144, 2250).map(lambda words: 4 * words)),
    }


@pytest.mark.long
@given(changes=asked())
@settings(max_examples=40, deadline=None)
def test_it_says_what_opening_finds(shared: Served, changes: dict[str, Any]) -> None:
    """Whatever the last program left: nothing is told of what fits, and something of what does not."""
    camera: Camera = camera_settings(gvcp_port=shared.port, **changes)
    lines = probe_camera(camera).disagreements
    driver = GigeCamera(camera)
    try:
        driver.open()
    except DeviceError:
        assert lines
    else:
        assert lines == ()
    finally:
        driver.close()


def test_asking_takes_no_control_and_writes_nothing(serve: Serve) -> None:
    served = serve()
    commands: set[int] = set()
    answer = served.mock._commands.copy()

    def listened(command: int) -> Callable[..., bytes | None]:
        def take(*arguments: Any) -> bytes | None:
            commands.add(command)
            return answer[command](*arguments)

        return take

    served.mock._commands.update({command: listened(command) for command in answer})
    told(served, width_px=48, gain=30.0)
    assert commands == {Command.READREG, Command.READMEM}


def test_a_camera_that_is_in_use_says_so_and_is_compared_all_the_same(
    serve: Serve, connect: Callable[..., GigeCamera]
) -> None:
    served = serve()
    camera = connect(served)
    camera.start()
    in_use, width = told(served, width_px=48)
    assert "another program has control" in in_use
    assert width.startswith("Width: ")
    assert camera.next_frame(5.0) is not None
