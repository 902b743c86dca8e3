"""`fitctl discover`: cameras and LabJacks in the network, serial ports and CAN interfaces of this machine."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from ipaddress import IPv4Address
from typing import Annotated

import can
import typer
from serial.tools import list_ports

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import JsonOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.config import ConfigError
from fitctl.drivers.gige.discovery import discover as discover_cameras
from fitctl.drivers.interface import DeviceUnreachable
from fitctl.drivers.labjack_t7.discovery import discover_labjacks


def discover(
    broadcast: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="Broadcast address of cameras and LabJacks."),
    ] = "255.255.255.255",
    wait_s: Annotated[
        float,
        typer.Option(
            "--timeout", metavar="SECONDS", min=0.01, max=60.0, help="Longest wait for answers."
        ),
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """List cameras, LabJacks, serial ports and CAN interfaces.

    Sends a broadcast to which cameras and LabJacks answer. A C-887 has no documented way of discovery. Exit
    status 1 if the broadcast could not be sent; --json then has null in place of what might be there.
    """
    try:
        IPv4Address(broadcast)
    except ValueError:
        msg = f"discover: --broadcast {broadcast}: expected an IPv4 address such as 192.168.1.255"
        raise ConfigError(msg) from None
    with ThreadPoolExecutor() as pool:
        cameras = pool.submit(_cameras, broadcast, wait_s)
        labjacks = pool.submit(_labjacks, broadcast, wait_s)
    found: dict[str, list[dict[str, str]] | None] = {
        "cameras": cameras.result(),
        "labjacks": labjacks.result(),
        "serial_ports": _serial_ports(),
        "can_interfaces": _can_interfaces(),
    }
    if as_json:
        say(to_json(found))
    for title, entries in () if as_json else found.items():
        there = "" if entries else ": not known" if entries is None else ": none"
        say(title.replace("_", " ") + there)
        for entry in entries or ():
            say("  " + "  ".join(str(value) for value in entry.values() if value))
    raise typer.Exit(FAILED if None in found.values() else 0)


def _cameras(broadcast: str, wait_s: float) -> list[dict[str, str]] | None:
    try:
        cameras = discover_cameras(broadcast, wait_s)
    except DeviceUnreachable as error:
        say(f"cameras: {error}", err=True)
        return None
    return [
        {"address": one.address, "mac": one.mac, "name": one.user_name, **asdict(one.identity)}
        for one in cameras
    ]


def _labjacks(broadcast: str, wait_s: float) -> list[dict[str, str]] | None:
    try:
        labjacks = discover_labjacks(broadcast, wait_s)
    except DeviceUnreachable as error:
        say(f"labjacks: {error}", err=True)
        return None
    return [{"address": one.address, **asdict(one.identity)} for one in labjacks]


def _serial_ports() -> list[dict[str, str]]:
    return [
        {"port": port.device, "description": port.description, "hardware": port.hwid}
        for port in sorted(list_ports.comports())
    ]


def _can_interfaces() -> list[dict[str, str]]:
    """Buses of the system and adapters by their makers' drivers; serial ports stand by themselves."""
    logging.getLogger("can").setLevel(logging.CRITICAL)  # of makers' drivers that are not installed
    known = can.detect_available_configs()
    return [
        {"interface": str(one["interface"]), "channel": str(one["channel"])}
        for one in known
        if one["interface"] not in {"serial", "virtual", "udp_multicast"}
    ]
