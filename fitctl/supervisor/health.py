"""How each device is, for the log and the consoles."""

from __future__ import annotations

from collections.abc import Mapping

from fitctl.config import Rig
from fitctl.drivers.interface import CameraCounts, DeviceIdentity
from fitctl.logging.records import CAMERA, DeviceHealth
from fitctl.loop.loop import StellarLoop

Identities = Mapping[str, DeviceIdentity]


def camera_health(
    rig: Rig, counts: CameraCounts, is_open: bool, identities: Identities, now_s: float
) -> DeviceHealth:
    """The camera, which all loops share."""
    return _health(
        CAMERA,
        rig.camera.device.endpoint,
        is_open,
        f"{counts.frames} frames, {counts.lost} lost, {counts.packets_lost} packets missed",
        identities,
        now_s,
    )


def loop_health(
    loop: StellarLoop, piezo_error: str, identities: Identities, now_s: float
) -> list[DeviceHealth]:
    """One loop's own devices."""
    servo, settings, name = loop.servo, loop.settings, loop.name
    powered = "enabled" if servo.enabled else "disabled"
    dac, piezo = settings.fsm.dac, settings.fsm.piezo
    return [
        _health(
            f"{name} siderostat",
            servo.endpoint,
            servo.opened,
            str(servo.fault) if servo.fault else powered,
            identities,
            now_s,
            fault=servo.fault is not None,
        ),
        _health(
            f"{name} D/A",
            dac.endpoint,
            loop.stages.ready,
            "written every tick" if loop.stages.ready else "not written",
            identities,
            now_s,
        ),
        _health(
            f"{name} piezo",
            piezo.port,
            loop.stages.ready,
            piezo_error or f"read every {piezo.poll_s:g} s",
            identities,
            now_s,
            fault=bool(piezo_error),
        ),
    ]


def _health(
    device: str,
    endpoint: str,
    is_open: bool,
    detail: str,
    identities: Identities,
    now_s: float,
    *,
    fault: bool = False,
) -> DeviceHealth:
    identity = identities.get(device)
    return DeviceHealth(
        time_s=now_s,
        device=device,
        endpoint=endpoint,
        state="fault" if fault else "ok" if is_open else "closed",
        identity="" if identity is None else f"{identity.model} {identity.serial}".strip(),
        detail=detail,
    )
