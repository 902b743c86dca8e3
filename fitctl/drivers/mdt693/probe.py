"""A piezo amplifier asked: it is left as it is."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import Mdt693Device
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.probe import Probe, round_trip_s


def probe_mdt693(piezo: Mdt693Device) -> Probe:
    """Who an amplifier is; its limits are held against the rig file on the way.

    Raises
    ------
    DeviceError
        If it does not answer, or its limits are not the rig file's.
    """
    with closing(Mdt693(piezo)) as driver:
        identity = driver.open()
        return Probe(identity, round_trip_s(driver.ask_once))
