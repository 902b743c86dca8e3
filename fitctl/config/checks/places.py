"""Where things are addressed: no two devices at one place, no two listeners on one port."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

from fitctl.config.checks.siderostat import REGISTERS
from fitctl.config.conflict import Conflict, Part
from fitctl.config.devices import BalAnalogDevice, Cia402Device, EnsembleDevice, ModbusDacDevice
from fitctl.config.loops import Loop
from fitctl.config.rig import Rig

_Places = list[tuple[str, str]]


def place_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of all devices, of the mocks, and of the ports that fitctl itself listens on."""
    yield from _twice(_lines(rig), "one serial line or socket serves one device", "another port")
    yield from _registers(rig)
    yield from _mocks(rig)
    yield from _service(rig)


def _twice(places: _Places, why: str, must_be: str) -> Iterator[Conflict]:
    first: dict[str, str] = {}
    for place, key in places:
        other = first.setdefault(place, key)
        if other != key:
            parts = (Part(key, place, must_be), Part(other, place, must_be))
            yield Conflict(why, parts)


def _lines(rig: Rig) -> _Places:
    """Serial ports and sockets that devices cannot share; drives may share an adapter."""
    places = []
    adapters = set()
    for name, loop in rig.loops.items():
        device, key = loop.siderostat.device, f"loops.{name}.siderostat.device"
        if isinstance(device, EnsembleDevice):
            places.append((device.port, f"{key}.port"))
        elif isinstance(device, Cia402Device) and device.interface == "slcan":
            if device.channel not in adapters:
                places.append((device.channel, f"{key}.channel"))
            adapters.add(device.channel)
        if isinstance(loop, Loop):
            dac = loop.fsm.dac
            if dac.transport == "rtu":
                places.append((dac.serial_port, f"loops.{name}.fsm.dac.serial_port"))
            places.append((loop.fsm.piezo.port, f"loops.{name}.fsm.piezo.port"))
    if rig.collector is not None:
        places.append((rig.collector.hexapod.port, "collector.hexapod.port"))
    return places


class _Outputs(NamedTuple):
    """Registers of a Modbus station that a device of the rig writes."""

    key: str
    station: dict[str, Any]
    register_key: str
    first: int


def _registers(rig: Rig) -> Iterator[Conflict]:
    """Outputs that two loops would write on one Modbus station."""
    for one, other in itertools.combinations(_outputs(rig), 2):
        if one.station != other.station or abs(one.first - other.first) >= REGISTERS:
            continue
        registers = [
            Part(
                f"{this.key}.{this.register_key}",
                this.first,
                f"at least {REGISTERS} from {that.first}",
            )
            for this, that in ((other, one), (one, other))
        ]
        stations = [
            Part(f"{this.key}.{name}", value, "another one")
            for this in (other, one)
            for name, value in this.station.items()
        ]
        yield Conflict("both would write the same outputs of one station", (*registers, *stations))


def _outputs(rig: Rig) -> Iterator[_Outputs]:
    for name, loop in rig.loops.items():
        device = loop.siderostat.device
        if isinstance(device, BalAnalogDevice):
            key, first = f"loops.{name}.siderostat.device", device.first_output_register
            yield _Outputs(key, _station(device), "first_output_register", first)
        if isinstance(loop, Loop) and loop.fsm.dac.transport == "tcp":
            dac = loop.fsm.dac
            key = f"loops.{name}.fsm.dac"
            yield _Outputs(key, _station(dac), "first_register", dac.first_register)


def _station(device: BalAnalogDevice | ModbusDacDevice) -> dict[str, Any]:
    return {"host": device.host, "port": device.port, "device_id": device.device_id}


def _mocks(rig: Rig) -> Iterator[Conflict]:
    if rig.mocks is None:
        return
    ports: list[tuple[int, str]] = [(rig.mocks.bench_port, "mocks.bench_port")]
    buses = set()
    for name, mocks in rig.mocks.loops.items():
        if name not in rig.loops:
            continue
        device, key = rig.loops[name].siderostat.device, f"mocks.loops.{name}"
        if isinstance(device, Cia402Device) and (device.interface, device.channel) not in buses:
            buses.add((device.interface, device.channel))
            ports.append((mocks.slcan_port, f"{key}.slcan_port"))
        if isinstance(device, EnsembleDevice) and mocks.ensemble is not None:
            ports.append((mocks.ensemble.tcp_port, f"{key}.ensemble.tcp_port"))
        if isinstance(device, BalAnalogDevice) and mocks.bal_analog is not None:
            ports.append((mocks.bal_analog.modbus_port, f"{key}.bal_analog.modbus_port"))
    for name, stellar in rig.mocks.stellar_loops.items():
        ports.append((stellar.modbus_port, f"mocks.loops.{name}.modbus_port"))
        ports.append((stellar.mdt693_port, f"mocks.loops.{name}.mdt693_port"))
    for name, metrology in rig.mocks.metrology_loops.items():
        ports.append((metrology.labjack.modbus_port, f"mocks.loops.{name}.labjack.modbus_port"))
    if rig.mocks.hexapod is not None:
        ports.append((rig.mocks.hexapod.tcp_port, "mocks.hexapod.tcp_port"))
    given = [(str(port), key) for port, key in ports if port]
    for conflict in _twice(given, "one mock listens on a port", "another port, or 0 for any"):
        parts = tuple(part._replace(value=int(part.value)) for part in conflict.parts)
        yield conflict._replace(parts=parts)


def _service(rig: Rig) -> Iterator[Conflict]:
    service = rig.service
    if not service.tcp_address or not service.metrics_port:
        return
    for key in ("command_port", "telemetry_port"):
        if service.metrics_port == getattr(service, key):
            yield Conflict(
                "each listens on a port of its own",
                tuple(
                    Part(f"service.{one}", service.metrics_port, "another port")
                    for one in ("metrics_port", key)
                ),
            )
