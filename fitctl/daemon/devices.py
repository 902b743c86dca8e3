"""The devices of a rig, made from its file: one table from driver name to driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fitctl.config import (
    AnyLoop,
    Mdt693Device,
    MetrologyLoop,
    ModbusDacDevice,
    Rig,
    Siderostat,
)
from fitctl.drivers.bal_analog.driver import BalAnalogAmplifiers
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.cia402.bus import CanBus
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.ensemble.driver import EnsembleAmplifiers
from fitctl.drivers.gige.aravis import AravisCamera
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import (
    Devices,
    LoopDevices,
    MirrorDac,
    PiezoAmplifier,
    ServoAmplifiers,
)
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.drivers.wiring import WiredAmplifiers, WiredBusAmplifiers, WiredDac, WiredPiezo

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


def amplifiers_of(settings: Siderostat[Any], bus: CanBus | None = None) -> ServoAmplifiers:
    """The driver of a siderostat's amplifiers, behind its cables; on `bus`, one for a bus of several."""
    if bus is not None:
        on_bus = Cia402Amplifiers(settings, bus)
        return on_bus if settings.wiring is None else WiredBusAmplifiers(on_bus, settings.wiring)
    alone = AMPLIFIERS[settings.device.driver](settings)
    return alone if settings.wiring is None else WiredAmplifiers(alone, settings.wiring)


def dac_of(settings: ModbusDacDevice) -> MirrorDac:
    """The driver of a D/A, behind its cables."""
    dac = DACS[settings.driver](settings)
    return dac if settings.channels is None else WiredDac(dac, settings.channels)


def piezo_of(settings: Mdt693Device) -> PiezoAmplifier:
    """The driver of a piezo amplifier, behind its cables."""
    piezo = PIEZOS[settings.driver](settings)
    return piezo if settings.channels is None else WiredPiezo(piezo, settings.channels)


def _loop_devices(loop: AnyLoop, bus: CanBus | None) -> LoopDevices:
    amplifiers = amplifiers_of(loop.siderostat, bus)
    if isinstance(loop, MetrologyLoop):
        device = loop.sensor.device
        return LoopDevices(amplifiers, photodiodes=PHOTODIODES[device.driver](device), bus=bus)
    return LoopDevices(
        amplifiers, dac=dac_of(loop.fsm.dac), piezo=piezo_of(loop.fsm.piezo), bus=bus
    )
