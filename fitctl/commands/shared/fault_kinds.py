"""What can go wrong with each kind of mock device; imports the mocks only when it is asked, for Tab."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fitctl.mocks.faults import FaultKind

_MOCKS = {
    "camera": "fitctl.mocks.gige.camera",
    "drive": "fitctl.mocks.cia402.drive",
    "drive (ensemble)": "fitctl.mocks.ensemble.controller",
    "drive (bal_analog)": "fitctl.mocks.bal_analog.station",
    "dac": "fitctl.mocks.modbus_dac.server",
    "mdt693": "fitctl.mocks.mdt693.server",
    "labjack": "fitctl.mocks.labjack_t7.server",
    "hexapod": "fitctl.mocks.c887.server",
}


def kinds() -> dict[str, Mapping[str, FaultKind]]:
    """The faults of each kind of device, by name."""
    return {name: importlib.import_module(module).FAULTS for name, module in _MOCKS.items()}
