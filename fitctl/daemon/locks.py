"""Locks that keep a second supervisor out: of the rig, and of every device that lets several masters in."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from fitctl.config import (
    BalAnalogDevice,
    Cia402Device,
    ConfigError,
    Loop,
    ModbusDacDevice,
    Rig,
)
from fitctl.config.addresses import SOCKET_URL
from fitctl.messages.endpoints import supervisor_name
from fitctl.processes import lock_held, name_held


@contextmanager
def only_supervisor(folder: Path) -> Iterator[None]:
    """Hold the rig's locks; a second supervisor on the same rig is refused.

    The name outlives a folder that vanishes; the file also holds where two processes have networks apart.

    Raises
    ------
    ConfigError
        If another holds one; the text names its process.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(name_held(supervisor_name(folder)))
            stack.enter_context(lock_held(folder / "lock"))
        except BlockingIOError as error:
            msg = (
                f"{folder}: another supervisor ({error.strerror}) has this rig; attach to it with "
                "`fitctl console`, or end it first"
            )
            raise ConfigError(msg) from None
        yield


@contextmanager
def only_master(rig: Rig) -> Iterator[None]:
    """Hold a lock for each address of :func:`device_addresses`, also against supervisors of other users.

    Raises
    ------
    ConfigError
        If another process holds one; the text names the device, the address and the process.
    """
    with ExitStack() as stack:
        for address, device in device_addresses(rig).items():
            try:
                stack.enter_context(name_held(f"fitctl-device:{address}"))
            except BlockingIOError as error:
                msg = (
                    f"{device}: {address} is in use by another supervisor ({error.strerror}), perhaps of "
                    "another rig file with the same device; end that supervisor, or correct the address"
                )
                raise ConfigError(msg) from None
        yield


def device_addresses(rig: Rig) -> dict[str, str]:
    """Addresses at which two masters could command one device at once, and what the rig has there.

    The camera is not among them: it gives control to one master by itself. Photodiodes are only read.
    """
    found: dict[str, str] = {}
    for name, loop in rig.loops.items():
        found.setdefault(_amplifiers(loop.siderostat.device), f"{name} siderostat")
        if isinstance(loop, Loop):
            found.setdefault(_modbus(loop.fsm.dac), f"{name} D/A")
            found.setdefault(_port(loop.fsm.piezo.port), f"{name} piezo")
    if rig.collector is not None:
        found.setdefault(_port(rig.collector.hexapod.port), "hexapod")
    return found


def _amplifiers(device: Any) -> str:
    match device:
        case Cia402Device(interface="slcan"):
            return _port(device.channel)
        case Cia402Device():
            return f"{device.interface}:{device.channel} node {device.node_id}"
        case BalAnalogDevice():
            return f"{_host(device.host, device.port)} unit {device.device_id}"
        case _:
            return _port(device.port)


def _modbus(device: ModbusDacDevice) -> str:
    if device.transport == "rtu":
        return _port(device.serial_port)
    return f"{_host(device.host, device.port)} unit {device.device_id}"


def _port(port: str) -> str:
    """A serial port by the file that its links lead to, or a socket."""
    if port.startswith(SOCKET_URL):
        host, _, number = port.removeprefix(SOCKET_URL).partition("/")[0].rpartition(":")
        return _host(host, number)
    return os.path.realpath(port)


def _host(host: str, port: int | str) -> str:
    """As one address is always written; names are not resolved, because that may take long."""
    try:
        host = ip_address(host.strip("[]")).compressed
    except ValueError:
        host = host.lower()
    return f"{host}:{port}"
