"""Rig files: TOML in, frozen and validated settings with units in their names out.

Every key is required, so that a rig file shows everything that fitctl will use. A wrong file ends in a
:class:`ConfigError` whose lines each name the file, the key and what is allowed.
"""

from fitctl.config.base import ARCSEC_PER_RAD, AxisPair, ConfigError, Range, is_name
from fitctl.config.devices import (
    AIN_RANGES_V,
    HALF_WINDOW_PX,
    BalAnalogDevice,
    Camera,
    Cia402Device,
    EnsembleDevice,
    Fsm,
    LabJackT7Device,
    Mdt693Device,
    ModbusDacDevice,
    Siderostat,
    StackHysteresis,
    Structure,
)
from fitctl.config.interlocks import QUANTITIES, Action, Interlock, ResetBy
from fitctl.config.loops import (
    CONTROLLERS,
    LEAST_OVERLAP,
    MOST_OVERLAP,
    AirPathModel,
    ControllerName,
    Logging,
    Loop,
    LqgLtr,
    Vernier,
)
from fitctl.config.mocks import (
    BalAnalogMock,
    DacMock,
    EnsembleMock,
    Fault,
    GigeMock,
    LabJackMock,
    LoopMocks,
    Mdt693Mock,
)
from fitctl.config.plant import AirPath, HotPixel, Hysteresis, Spot
from fitctl.config.reading import lay_over, load_rig, rig_from_document, rig_from_log
from fitctl.config.rig import Rig, default_rig_path

__all__ = [
    "AIN_RANGES_V",
    "ARCSEC_PER_RAD",
    "CONTROLLERS",
    "HALF_WINDOW_PX",
    "LEAST_OVERLAP",
    "MOST_OVERLAP",
    "QUANTITIES",
    "Action",
    "AirPath",
    "AirPathModel",
    "AxisPair",
    "BalAnalogDevice",
    "BalAnalogMock",
    "Camera",
    "Cia402Device",
    "ConfigError",
    "ControllerName",
    "DacMock",
    "EnsembleDevice",
    "EnsembleMock",
    "Fault",
    "Fsm",
    "GigeMock",
    "HotPixel",
    "Hysteresis",
    "Interlock",
    "LabJackMock",
    "LabJackT7Device",
    "Logging",
    "Loop",
    "LoopMocks",
    "LqgLtr",
    "Mdt693Device",
    "Mdt693Mock",
    "ModbusDacDevice",
    "Range",
    "ResetBy",
    "Rig",
    "Siderostat",
    "Spot",
    "StackHysteresis",
    "Structure",
    "Vernier",
    "default_rig_path",
    "is_name",
    "lay_over",
    "load_rig",
    "rig_from_document",
    "rig_from_log",
]
