"""The devices of a rig, made from its file: one table from driver name to driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fitctl.config import AnyLoop, MetrologyLoop, Rig, Siderostat
from fitctl.drivers.bal_analog.driver import BalAnalogAmplifiers
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.cia402.bus import CanBus
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.ensemble.driver import EnsembleAmplifiers
from fitctl.drivers.gige.aravis import AravisCamera
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import Devices, LoopDevices, ServoAmplifiers
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.modbus_dac.driver import ModbusDac

CAMERAS: dict[str, type[AravisCamera | GigeCamera]] = {"gige": GigeCamera, "aravis": AravisCamera}
AMPLIFIERS: dict[str, Callable[[Siderostat[Any]], ServoAmplifiers]] = {
    "cia402": Cia402Amplifiers,
    "ensemble": EnsembleAmplifiers,
    "bal_analog": BalAnalogAmplifiers,
}
DACS = {"modbus_dac": ModbusDac}
PIEZOS = {"mdt693": Mdt693}
PHOTODIODES = {"labjack_t7": LabJackT7}
HEXAPODS = {"c887": C887Hexapod}


def rig_devices(rig: Rig) -> Devices:
    """Drivers for every device that the rig file names; none is opened yet."""
    buses = can_buses(rig)
    return Devices(
        camera=CAMERAS[rig.camera.device.driver](rig.camera),
        loops={name: _loop_devices(loop, buses.get(name)) for name, loop in rig.loops.items()},
        hexapod=HEXAPODS[rig.collector.hexapod.driver](rig.collector.hexapod)
        if rig.collector is not None
        else None,
    )


def can_buses(rig: Rig) -> dict[str, CanBus]:
    """The CAN bus of each loop that has one, in rigs where several have: one thread servoes them all."""
    buses = {name: bus for drives in rig.can_buses for bus in [CanBus()] for name in drives}
    return buses if len(buses) > 1 else {}


def _loop_devices(loop: AnyLoop, bus: CanBus | None) -> LoopDevices:
    settings: Siderostat[Any] = loop.siderostat
    amplifiers = (
        AMPLIFIERS[settings.device.driver](settings)
        if bus is None
        else Cia402Amplifiers(settings, bus)
    )
    if isinstance(loop, MetrologyLoop):
        device = loop.sensor.device
        return LoopDevices(amplifiers, photodiodes=PHOTODIODES[device.driver](device), bus=bus)
    return LoopDevices(
        amplifiers,
        dac=DACS[loop.fsm.dac.driver](loop.fsm.dac),
        piezo=PIEZOS[loop.fsm.piezo.driver](loop.fsm.piezo),
        bus=bus,
    )
