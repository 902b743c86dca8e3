"""Faults on demand: what can go wrong with a mock, what is wrong now, what that makes of its messages."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable, Mapping
from typing import NamedTuple

from fitctl.config import Fault

_REORDER_LIMIT_S = 0.1


class FaultKind(NamedTuple):
    """One thing that can go wrong.

    Attributes
    ----------
    text : str
        What happens then, for people.
    unit : str
        Of its value; without a unit it takes none.
    value : float
        Where the fault gives none.
    parts : tuple of str
        What of the device it can be limited to; without any it is the whole device.
    least, most : float
        What its value may be.
    """

    text: str
    unit: str = ""
    value: float = math.nan
    parts: tuple[str, ...] = ()
    least: float = -math.inf
    most: float = math.inf


WIRE_FAULTS = {
    "drop": FaultKind("what the device sends is lost"),
    "delay": FaultKind("what the device sends arrives later", "s", 0.1, least=0.0),
    "corrupt": FaultKind("one bit of what the device sends is flipped"),
    "duplicate": FaultKind("what the device sends arrives twice"),
    "reorder": FaultKind("what the device sends arrives after its next message"),
    "disconnect": FaultKind("connections are cut and none is accepted"),
    "freeze": FaultKind("connections stay open, but the device reads and sends nothing"),
    "reboot": FaultKind(
        "power is cycled: the device is off for this long, then as at power-up",
        "s",
        2.0,
        least=0.0,
    ),
}
"""Every device has these; each takes effect message by message with the fault's probability."""


class UnknownFault(ValueError):
    """The device has no such fault; the text lists its faults."""


class Faults:
    """What is wrong with one device now.

    Parameters
    ----------
    kinds : mapping
        What can go wrong with it: `WIRE_FAULTS` and its own.
    """

    def __init__(self, kinds: Mapping[str, FaultKind]) -> None:
        self.kinds = kinds
        self._random = random.Random(0)  # noqa: S311 - not for secrets
        self._active: dict[tuple[str, str], Fault] = {}
        self._ends: dict[tuple[str, str], asyncio.TimerHandle] = {}
        self._watchers: list[Callable[[str], None]] = []

    @property
    def active(self) -> list[Fault]:
        """All that is wrong now."""
        return list(self._active.values())

    @property
    def away(self) -> bool:
        """Cut off or without power."""
        return self.value("disconnect") is not None or self.value("reboot") is not None

    def on_change(self, watcher: Callable[[str], None]) -> None:
        """Call `watcher` with the kind of each fault that begins or ends."""
        self._watchers.append(watcher)

    def set(self, fault: Fault) -> None:
        """Begin a fault; an earlier one of its kind and part gives way.

        Raises
        ------
        UnknownFault
            If the device has no such fault or part, or the fault takes no value.
        """
        kind = check_fault(fault, self.kinds)
        key = (fault.kind, fault.part)
        self._stop_timer(key)
        self._active[key] = fault
        lasts_s = fault.for_s
        if fault.kind == "reboot":
            lasts_s = kind.value if fault.value is None else fault.value
        if lasts_s is not None:
            loop = asyncio.get_running_loop()
            self._ends[key] = loop.call_later(lasts_s, self._end, key)
        self._notify(fault.kind)

    def clear(self, kind: str = "", part: str = "") -> None:
        """End the faults of a kind, or of one part of it; without a kind all of them."""
        for key in list(self._active):
            if kind in {"", key[0]} and part in {"", key[1]}:
                self._end(key)

    def close(self) -> None:
        """End all faults without notifying anyone: the device is being stopped."""
        self._watchers.clear()
        self.clear()

    def value(self, kind: str, part: str = "") -> float | None:
        """The value of an active fault, nan if it takes none; None where all is well."""
        fault = self._find(kind, part)
        if fault is None:
            return None
        return self.kinds[kind].value if fault.value is None else fault.value

    def strikes(self, kind: str, part: str = "") -> bool:
        """Whether an active fault hits this time."""
        fault = self._find(kind, part)
        return fault is not None and (
            fault.probability == 1 or self._random.random() < fault.probability
        )

    def turn_a_bit(self, message: bytes) -> bytes:
        """The message with one bit wrong."""
        changed = bytearray(message)
        if changed:
            bit = self._random.randrange(8 * len(changed))
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)

    def _find(self, kind: str, part: str) -> Fault | None:
        return self._active.get((kind, part)) or self._active.get((kind, ""))

    def _end(self, key: tuple[str, str]) -> None:
        self._stop_timer(key)
        del self._active[key]
        self._notify(key[0])

    def _stop_timer(self, key: tuple[str, str]) -> None:
        timer = self._ends.pop(key, None)
        if timer is not None:
            timer.cancel()

    def _notify(self, kind: str) -> None:
        for watcher in self._watchers:
            watcher(kind)


class Wire:
    """What a device sends to one client, message by message, through its faults.

    Parameters
    ----------
    faults : Faults
    send : callable
        Takes the bytes that do go out.
    """

    def __init__(self, faults: Faults, send: Callable[[bytes], None]) -> None:
        self._faults = faults
        self._send = send
        self._held: bytes | None = None
        self._timers: set[asyncio.TimerHandle] = set()

    def send(self, message: bytes) -> None:
        """Send a message, or what the faults make of it; never waits."""
        faults = self._faults
        if not faults.active:
            self._send(message)
            return
        if self.dead or faults.strikes("drop"):
            return
        if faults.strikes("corrupt"):
            message = faults.turn_a_bit(message)
        if self._held is not None:
            self._release(message)
        elif faults.strikes("reorder"):
            self._held = message
            self._later(_REORDER_LIMIT_S, self._release)
        else:
            self._out(message)

    @property
    def dead(self) -> bool:
        """Nothing goes in or out now: also what a client sends is to be thrown away."""
        return self._faults.away or self._faults.value("freeze") is not None

    def close(self) -> None:
        """Forget what is still to be sent."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._held = None

    def _release(self, first: bytes = b"") -> None:
        held, self._held = self._held, None
        for message in (first, held):
            if message:
                self._out(message)

    def _out(self, message: bytes) -> None:
        times = 2 if self._faults.strikes("duplicate") else 1
        delay_s = self._faults.value("delay")
        for _ in range(times):
            if delay_s is not None and self._faults.strikes("delay"):
                self._later(delay_s, self._send, message)
            else:
                self._send(message)

    def _later(self, delay_s: float, action: Callable[..., None], *arguments: bytes) -> None:
        def run() -> None:
            self._timers.discard(timer)
            action(*arguments)

        timer = asyncio.get_running_loop().call_later(delay_s, run)
        self._timers.add(timer)


def known_kind(device: str, name: str, part: str, kinds: Mapping[str, FaultKind]) -> FaultKind:
    """The kind of that name.

    Raises
    ------
    UnknownFault
        If the device has no such kind, or that no such part.
    """
    kind = kinds.get(name)
    if kind is None:
        msg = f"{device} has no fault {name}; it has {', '.join(kinds)}"
        raise UnknownFault(msg)
    if part and part not in kind.parts:
        having = f"it has {', '.join(kind.parts)}" if kind.parts else "it is of the whole device"
        msg = f"{device}: fault {name} has no part {part}; {having}"
        raise UnknownFault(msg)
    return kind


def check_fault(fault: Fault, kinds: Mapping[str, FaultKind]) -> FaultKind:
    """The kind of a fault.

    Raises
    ------
    UnknownFault
        If there is no such kind or part, or the fault takes no value, or not this one.
    """
    kind = known_kind(fault.device, fault.kind, fault.part, kinds)
    if fault.value is not None and not kind.unit:
        msg = f"{fault.device}: fault {fault.kind} takes no value"
        raise UnknownFault(msg)
    if fault.value is not None and not kind.least <= fault.value <= kind.most:
        msg = (
            f"{fault.device}: fault {fault.kind} {fault.value:g}: expected {kind.least:g} to {kind.most:g} "
            f"({kind.unit})"
        )
        raise UnknownFault(msg)
    return kind
