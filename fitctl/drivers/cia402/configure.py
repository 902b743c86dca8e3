"""What the drive is checked for and set to before it is started: identity, modes, units, PDOs, heartbeat.

`probe_drive` checks without setting anything.
"""

from __future__ import annotations

from contextlib import closing

from fitctl.config import Cia402Device, Siderostat
from fitctl.drivers.amplifiers import AXES
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.link import CanLink
from fitctl.drivers.cia402.node import Node
from fitctl.drivers.cia402.protocol import NmtCommand
from fitctl.drivers.interface import DeviceIdentity, DeviceMismatch, DeviceRefused
from fitctl.drivers.probe import Probe, round_trip_s

_PREFERRED_MODES = (protocol.CYCLIC_SYNCHRONOUS_VELOCITY, protocol.PROFILE_VELOCITY)


def configure(node: Node, device: Cia402Device, position_limit_counts: int) -> DeviceIdentity:
    """Bring the drive to PRE-OPERATIONAL, check it and set it; no motor has current afterwards.

    Parameters
    ----------
    node : Node
    device : Cia402Device
    position_limit_counts : int
        The drive's own limit of both axes, each way; 0 leaves what it has.

    Raises
    ------
    DeviceMismatch
        Not a CiA 402 drive with two axes and a velocity mode.
    DeviceTimeout, DeviceRefused, DeviceProtocolError
        The drive does not answer, or does not take a setting.
    """
    node.command(NmtCommand.PRE_OPERATIONAL)
    profile = node.read(protocol.DEVICE_TYPE, 0, "I") & 0xFFFF
    if profile != protocol.DRIVE_PROFILE:
        raise _mismatch(node, "device profile 402 in object 1000", str(profile))
    identity = drive_identity(node)
    node.guard(on=False)
    for name, offset in zip(AXES, (0, protocol.AXIS_OFFSET), strict=True):
        _configure_axis(node, name, offset)
        _watch_over_link(node, offset)
        if position_limit_counts:
            limits = protocol.POSITION_LIMITS + offset
            node.write(limits, 1, "i", -position_limit_counts)
            node.write(limits, 2, "i", position_limit_counts)
    _configure_pdos(node, device.node_id)
    heartbeat_ms = round(device.drive_heartbeat_s * 1e3)
    node.write(protocol.HEARTBEAT_PRODUCER, 0, "H", heartbeat_ms)
    return identity


def probe_drive(siderostat: Siderostat) -> Probe:
    """Who a drive is, and whether its axes are fit to be servoed.

    Raises
    ------
    DeviceError
        If there is no adapter, or no CiA 402 drive behind it.
    """
    device = siderostat.device
    with closing(Node(CanLink(device), device)) as node:
        identity = drive_identity(node)
        question_s = round_trip_s(lambda: node.read(protocol.DEVICE_TYPE, 0, "I"))
        disagreements = []
        for name, offset in zip(AXES, (0, protocol.AXIS_OFFSET), strict=True):
            if not velocity_modes(node, offset):
                disagreements.append(
                    f"{name} has no velocity mode (6502): set the drive up for one"
                )
            code = node.read(protocol.ERROR_CODE + offset, 0, "H")
            if code:
                disagreements.append(
                    f"{name} reports {protocol.error_text(code)}: remove its cause; fitctl clears it at standby"
                )
    return Probe(identity, question_s, tuple(disagreements))


def drive_identity(node: Node) -> DeviceIdentity:
    """Maker, model, serial number and firmware, from objects 1018, 1008 and 100A."""
    vendor, product, _revision, serial = (
        node.read(protocol.IDENTITY, subindex, "I") for subindex in (1, 2, 3, 4)
    )
    return DeviceIdentity(
        maker=f"vendor 0x{vendor:08X}",
        model=node.text(protocol.DEVICE_NAME) or f"product 0x{product:08X}",
        serial=str(serial),
        firmware=node.text(protocol.SOFTWARE_VERSION),
    )


def velocity_modes(node: Node, offset: int) -> list[int]:
    """The velocity modes of the axis whose objects begin at `offset`, the better one first."""
    supported = node.read(protocol.SUPPORTED_MODES + offset, 0, "I")
    return [mode for mode in _PREFERRED_MODES if supported >> (mode - 1) & 1]


def _configure_axis(node: Node, name: str, offset: int) -> None:
    node.write(protocol.CONTROLWORD + offset, 0, "H", protocol.CW_DISABLE_VOLTAGE)
    modes = velocity_modes(node, offset)
    if not modes:
        expected = f"{name}: mode 9 or 3 in object {protocol.SUPPORTED_MODES + offset:04X}"
        raise _mismatch(node, expected, "neither")
    node.write(protocol.UNIT_VELOCITY + offset, 0, "I", protocol.UNIT_MILLI_RPM)
    node.write(protocol.MODE + offset, 0, "b", modes[0])
    node.write(protocol.TARGET_VELOCITY + offset, 0, "i", 0)


def _watch_over_link(node: Node, offset: int) -> None:
    """See that a lost connection stops the axis; without object 6007, that is the maker's choice."""
    try:
        option = node.read(protocol.ABORT_OPTION + offset, 0, "h")
    except DeviceRefused:
        return
    if option == protocol.ABORT_IS_NOTHING:
        node.write(protocol.ABORT_OPTION + offset, 0, "h", protocol.ABORT_IS_FAULT)


def _configure_pdos(node: Node, node_id: int) -> None:
    rpdos = protocol.RPDO_COMMUNICATION, protocol.RPDO_MAPPING
    tpdos = protocol.TPDO_COMMUNICATION, protocol.TPDO_MAPPING
    every_sync, on_event = protocol.EVERY_SYNC, protocol.ON_EVENT
    velocities = protocol.RPDO1_BASE + node_id
    positions = protocol.TPDO1_BASE + node_id | protocol.PDO_NO_RTR
    statuswords = protocol.TPDO2_BASE + node_id | protocol.PDO_NO_RTR
    _configure_pdo(node, rpdos, 0, velocities, every_sync, (protocol.TARGET_VELOCITY, 32))
    _configure_pdo(node, tpdos, 0, positions, every_sync, (protocol.POSITION, 32))
    _configure_pdo(node, tpdos, 1, statuswords, on_event, (protocol.STATUSWORD, 16))
    node.write(protocol.TPDO_COMMUNICATION + 1, 5, "H", protocol.STATUS_EVERY_MS)


def _configure_pdo(
    node: Node,
    parameters: tuple[int, int],
    number: int,
    cob_id: int,
    transmission: int,
    mapped: tuple[int, int],
) -> None:
    """Map one object of both axes, in the order that CiA 301 asks for: out of service, map, back."""
    communication, mapping = (index + number for index in parameters)
    index, bits = mapped
    node.write(communication, 1, "I", cob_id | protocol.PDO_DISABLED)
    node.write(mapping, 0, "B", 0)
    node.write(mapping, 1, "I", protocol.mapping_entry(index, 0, bits))
    node.write(mapping, 2, "I", protocol.mapping_entry(index + protocol.AXIS_OFFSET, 0, bits))
    node.write(mapping, 0, "B", 2)
    node.write(communication, 2, "B", transmission)
    node.write(communication, 1, "I", cob_id)


def _mismatch(node: Node, expected: str, got: str) -> DeviceMismatch:
    hint = "check siderostat.device.node_id, and the drive's model and firmware"
    return node.endpoint.error(DeviceMismatch, expected, got, hint)
