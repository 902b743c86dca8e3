"""Which devices of a rig are mocks, and what a mixture of mocks and hardware cannot do."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import ip_address
from typing import NamedTuple
from urllib.parse import urlsplit

from fitctl.config.addresses import SOCKET_URL
from fitctl.config.loops import Loop
from fitctl.config.rig import Rig

_PTYS = "/dev/pts/"  # where `fitctl mocks` has serial lines


class Place(NamedTuple):
    """A device of a rig.

    Attributes
    ----------
    device : str
        What people call it, such as ``right D/A``.
    at : str
        Where it is addressed.
    simulated : bool
        The rig has mocks, and the device is addressed on this machine, where they listen.
    """

    device: str
    at: str
    simulated: bool


def places(rig: Rig) -> dict[str, Place]:
    """All devices of a rig by their names."""
    found = [("camera", rig.camera.device.endpoint)]
    for name, loop in rig.loops.items():
        found.append((f"{name} siderostat", loop.siderostat.device.endpoint))
        if isinstance(loop, Loop):
            found.append((f"{name} D/A", loop.fsm.dac.endpoint))
            found.append((f"{name} piezo amplifier", loop.fsm.piezo.port))
        else:
            found.append((f"{name} photodiodes", loop.sensor.device.endpoint))
    if rig.collector is not None:
        found.append(("hexapod", rig.collector.hexapod.port))
    return {
        device: Place(device, at, rig.mocks is not None and _is_here(at)) for device, at in found
    }


def _is_here(at: str) -> bool:
    if at.startswith(_PTYS):
        return True
    try:
        host = urlsplit(at if at.startswith(SOCKET_URL) else f"//{at}").hostname or ""
    except ValueError:  # not every CAN channel can be read as a host
        return False
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def mixture(rig: Rig) -> list[str]:
    """Which devices are real and which simulated, and what to know of that; nothing where all are alike."""
    found = places(rig).values()
    simulated = [place.device for place in found if place.simulated]
    real = [place.device for place in found if not place.simulated]
    if not simulated or not real:
        return []
    return [f"real: {', '.join(real)}; simulated: {', '.join(simulated)}", *mixture_warnings(rig)]


def mixture_warnings(rig: Rig) -> list[str]:
    """What to know before a rig runs that has both mocks and hardware: a line each."""
    return [f"warning: {line}" for line in _warnings(rig, places(rig))]


def _warnings(rig: Rig, found: dict[str, Place]) -> Iterator[str]:
    for name, loop in rig.loops.items():
        stages = [f"{name} siderostat"]
        sensor = "camera" if isinstance(loop, Loop) else f"{name} photodiodes"
        if isinstance(loop, Loop):
            stages.append(f"{name} D/A")
            if found[f"{name} piezo amplifier"].simulated and not found[f"{name} D/A"].simulated:
                yield (
                    f"loop {name}: the D/A is real and the piezo amplifier simulated, so nothing checks the "
                    "voltage limit of the amplifier behind the D/A; set its limit switch by hand before standby"
                )
        real = [stage for stage in stages if not found[stage].simulated]
        mocked = [stage for stage in stages if found[stage].simulated]
        if real and found[sensor].simulated:
            yield (
                f"loop {name}: {' and '.join(real)} real, {sensor} simulated: the mock does not see what they "
                "move, so a closed loop runs to its limits; do not acquire with this rig"
            )
        if mocked and not found[sensor].simulated:
            yield (
                f"loop {name}: {sensor} real, {' and '.join(mocked)} simulated: the mocks move nothing that it "
                "sees, so the loop finds and holds nothing"
            )
