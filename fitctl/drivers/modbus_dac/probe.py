"""A D/A station asked: its outputs stay as they are."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import ModbusDacDevice
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.drivers.probe import Probe, round_trip_s


def probe_dac(dac: ModbusDacDevice) -> Probe:
    """Who a station is; that its three registers can be read is seen on the way.

    Raises
    ------
    DeviceError
        If it does not answer, or has no such registers.
    """
    with closing(ModbusDac(dac)) as driver:
        identity = driver.open()
        return Probe(identity, round_trip_s(driver.read_counts))
