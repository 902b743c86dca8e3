"""How each device is, for the log and the consoles."""

from __future__ import annotations

from collections.abc import Mapping

from fitctl.config import Rig
from fitctl.drivers.interface import CameraCounts, DeviceIdentity
from fitctl.logging.records import CAMERA, HEXAPOD, DeviceHealth
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop
from fitctl.loop.stellar import StellarLoop
from fitctl.supervisor.collector import CollectorWatch
from fitctl.supervisor.piezo import PiezoWatch

Identities = Mapping[str, DeviceIdentity]


def camera_health(
    rig: Rig,
    counts: CameraCounts,
    skipped: int,
    is_open: bool,
    identities: Identities,
    now_s: float,
) -> DeviceHealth:
    """The camera, which all loops share."""
    detail = f"{counts.frames} frames, {counts.lost} lost"
    # Most rows of a console have no room for counts that say that nothing happened.
    for count, what in ((counts.packets_lost, "packets missed"), (skipped, "skipped")):
        detail += f", {count} {what}" if count else ""
    return _health(
        CAMERA,
        rig.camera.device.endpoint,
        is_open,
        detail,
        identities,
        now_s,
    )


def siderostat_health(loop: Loop, identities: Identities, now_s: float) -> DeviceHealth:
    """A loop's amplifiers."""
    servo = loop.servo
    powered = "enabled" if servo.enabled else "disabled"
    return _health(
        f"{loop.name} siderostat",
        servo.endpoint,
        servo.opened,
        str(servo.fault) if servo.fault else powered,
        identities,
        now_s,
        fault=servo.fault is not None,
    )


def mirror_health(
    loop: StellarLoop, piezo: PiezoWatch, identities: Identities, now_s: float
) -> list[DeviceHealth]:
    """What is before a loop's mirror: D/A and piezo amplifier."""
    fsm, is_written = loop.settings.fsm, loop.mirror.ready
    return [
        _health(
            f"{loop.name} D/A",
            fsm.dac.endpoint,
            is_written,
            "written every tick" if is_written else "not written",
            identities,
            now_s,
        ),
        _health(
            f"{loop.name} piezo",
            fsm.piezo.port,
            piezo.is_open,
            piezo.error or f"read every {fsm.piezo.poll_s:g} s",
            identities,
            now_s,
            fault=bool(piezo.error),
        ),
    ]


def photodiode_health(loop: MetrologyLoop, identities: Identities, now_s: float) -> DeviceHealth:
    """The A/D converter of a metrology loop's photodiodes."""
    return _health(
        f"{loop.name} photodiodes",
        loop.settings.sensor.device.endpoint,
        loop.sampled,
        "sampled every tick" if loop.sampled else "not sampled",
        identities,
        now_s,
    )


def hexapod_health(collector: CollectorWatch, now_s: float) -> DeviceHealth:
    """The hexapod under the collector."""
    identity = collector.identity
    return _health(
        HEXAPOD,
        collector.endpoint,
        collector.is_open,
        collector.detail,
        {} if identity is None else {HEXAPOD: identity},
        now_s,
        fault=bool(collector.error),
    )


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
