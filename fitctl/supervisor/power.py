"""Opening and closing all devices of some loops: slow work, which the executor does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.drivers.interface import DeviceIdentity, Devices
from fitctl.logging.records import CAMERA
from fitctl.stages.servo import SiderostatServo

ClosedBadly = Callable[[str, Exception], None]
Servos = Mapping[str, SiderostatServo]


class Opened(NamedTuple):
    """What opening the devices found: who they are, and by loop what its D/A is set to."""

    identities: dict[str, DeviceIdentity]
    stack_v: dict[str, NDArray[np.float64]]


def open_devices(
    devices: Devices,
    servos: Servos,
    names: Sequence[str],
    with_camera: bool,
    closed_badly: ClosedBadly,
) -> Opened:
    """Open everything anew. Limits are checked first; nothing is powered before all of it is well.

    Raises
    ------
    DeviceError
        Of the first device that is not well.
    """
    close_devices(devices, servos, names, with_camera, closed_badly)
    opened = Opened({}, {})
    for name in names:
        loop = devices.loops[name]
        if loop.piezo is not None:
            opened.identities[f"{name} piezo"] = loop.piezo.open()
        if loop.photodiodes is not None:
            opened.identities[f"{name} photodiodes"] = loop.photodiodes.open()
        if loop.dac is not None:
            opened.identities[f"{name} D/A"] = loop.dac.open()
            opened.stack_v[name] = loop.dac.read_v()
    if with_camera:
        opened.identities[CAMERA] = devices.camera.open()
    for name in names:
        opened.identities[f"{name} siderostat"] = servos[name].open()
    if with_camera:
        devices.camera.start()
    return opened


def close_devices(
    devices: Devices,
    servos: Servos,
    names: Sequence[str],
    with_camera: bool,
    closed_badly: ClosedBadly,
) -> None:
    """Close each device, whatever becomes of the others."""
    closing: dict[str, Callable[[], None]] = {}
    for name in names:
        loop = devices.loops[name]
        closing[f"{name} siderostat"] = servos[name].close
        if loop.photodiodes is not None:
            closing[f"{name} photodiodes"] = loop.photodiodes.close
        if loop.dac is not None:
            closing[f"{name} D/A"] = loop.dac.close
        if loop.piezo is not None:
            closing[f"{name} piezo"] = loop.piezo.close
    if with_camera:
        closing[CAMERA] = devices.camera.close
    for device, close in closing.items():
        try:
            close()
        except Exception as error:
            closed_badly(device, error)
