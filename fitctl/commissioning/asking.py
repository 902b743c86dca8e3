"""Which of a rig's devices answer, and whether they are as the rig file says: nothing is set, nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from fitctl.config import Loop, Rig
from fitctl.config.simulated import places
from fitctl.drivers.bal_analog.driver import probe_bal_analog
from fitctl.drivers.c887.driver import probe_c887
from fitctl.drivers.cia402.configure import probe_drive
from fitctl.drivers.ensemble.driver import probe_ensemble
from fitctl.drivers.gige.probe import probe_camera
from fitctl.drivers.interface import DeviceError, DeviceIdentity, DeviceTimeout, DeviceUnreachable
from fitctl.drivers.labjack_t7.driver import probe_labjack
from fitctl.drivers.mdt693.driver import probe_mdt693
from fitctl.drivers.modbus_dac.probe import probe_dac
from fitctl.drivers.probe import Probe

_CAN_DRIVER = "cia402"
NOT_STARTED = "simulated, and the mocks are not started: run `fitctl mocks` with this rig"
PROBES: dict[str, Callable[[Any], Probe]] = {
    "gige": probe_camera,
    "aravis": probe_camera,
    "cia402": probe_drive,
    "ensemble": probe_ensemble,
    "bal_analog": probe_bal_analog,
    "modbus_dac": probe_dac,
    "mdt693": probe_mdt693,
    "labjack_t7": probe_labjack,
    "c887": probe_c887,
}


class Finding(NamedTuple):
    """What became of asking one device.

    Attributes
    ----------
    device : str
    driver : str
    found : bool
        Something answered.
    identity : DeviceIdentity or None
    round_trip_ms : float or None
    disagreements : list of str
        Empty where all is as the rig file says.
    note : str
        What to know of it that is no failure.
    """

    device: str
    driver: str
    found: bool
    identity: DeviceIdentity | None
    round_trip_ms: float | None
    disagreements: list[str]
    note: str = ""


def examine_all(rig: Rig) -> list[Finding]:
    """Ask all devices at once, but drives on one CAN bus one after the other: its adapter serves one."""
    buses = {name: number for number, drives in enumerate(rig.can_buses) for name in drives}
    lines: dict[Any, list[tuple[str, str, Any]]] = {}
    parts = list(parts_of(rig))
    for part in parts:
        device, driver, _ = part
        line = buses[device.removesuffix(" siderostat")] if driver == _CAN_DRIVER else device
        lines.setdefault(line, []).append(part)
    with ThreadPoolExecutor(len(lines)) as pool:
        asked = pool.map(lambda line: [examine(*part) for part in line], lines.values())
        findings = {finding.device: finding for line in asked for finding in line}
    return [findings[device] for device, _, _ in parts]


def without_mocks(rig: Rig, findings: list[Finding]) -> list[Finding]:
    """What was found, where no mock answers: then `fitctl mocks` does not run, and no mock has failed."""
    simulated = {name for name, place in places(rig).items() if place.simulated}
    if any(finding.found for finding in findings if finding.device in simulated):
        return findings
    return [
        finding._replace(disagreements=[], note=NOT_STARTED)
        if finding.device in simulated
        else finding
        for finding in findings
    ]


def examine(device: str, driver: str, settings: Any) -> Finding:
    """Ask one device; `settings` is what its driver takes from the rig file."""
    try:
        probe = PROBES[driver](settings)
    except DeviceError as error:
        found = not isinstance(error, (DeviceUnreachable, DeviceTimeout))
        return Finding(device, driver, found, None, None, [str(error)])
    round_trip_ms = 1e3 * probe.round_trip_s
    return Finding(device, driver, True, probe.identity, round_trip_ms, list(probe.disagreements))


def parts_of(rig: Rig) -> Iterator[tuple[str, str, Any]]:
    """Each device of a rig: its name, its driver, and what the driver takes from the rig file."""
    yield "camera", rig.camera.device.driver, rig.camera
    for name, loop in rig.loops.items():
        yield f"{name} siderostat", loop.siderostat.device.driver, loop.siderostat
        if isinstance(loop, Loop):
            yield f"{name} D/A", loop.fsm.dac.driver, loop.fsm.dac
            yield f"{name} piezo amplifier", loop.fsm.piezo.driver, loop.fsm.piezo
        else:
            yield f"{name} photodiodes", loop.sensor.device.driver, loop.sensor.device
    if rig.collector is not None:
        yield "hexapod", rig.collector.hexapod.driver, rig.collector.hexapod
