"""A drive asked by SDO only: its state stays as it is."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import Siderostat
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.configure import drive_identity, velocity_modes
from fitctl.drivers.cia402.link import CanLink
from fitctl.drivers.cia402.node import Node
from fitctl.drivers.probe import Probe, round_trip_s


def probe_drive(siderostat: Siderostat) -> Probe:
    """Who a drive is, and whether its axes are fit to be servoed.

    Raises
    ------
    DeviceError
        If there is no adapter, or no CiA 402 drive behind it.
    """
    device = siderostat.device
    with closing(CanLink(device)) as link:
        node = Node(link, device)
        identity = drive_identity(node)
        question_s = round_trip_s(lambda: node.read(protocol.DEVICE_TYPE, 0, "I"))
        disagreements = []
        for name, offset in zip(protocol.AXES, (0, protocol.AXIS_OFFSET), strict=True):
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
