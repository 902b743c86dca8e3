"""A driver's line to its device: every exchange takes time, and may fail with the errors of a real driver."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from random import Random
from typing import TypeVar

from benchmarks.swarm.threads import VirtualTime
from fitctl.drivers.interface import (
    DeviceIdentity,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

Result = TypeVar("Result")

WRONG_S = 10.0  # after wrong values, loops may still be misled by them
_SLICE_S = 0.0005
_SELDOM = 0.2  # a device is heard soon enough that fails in no larger part of the calls

FAULTS = ("slow", "deaf", "mute", "refuses", "garbled", "unplugged")
"""Faults of a line, in this order: late answers, lost requests, lost answers, a device that refuses,
answers that make no sense, and a cable that is unplugged."""
WRONG: dict[str, tuple[str, ...]] = {
    "siderostat": ("trip", "stuck", "encoder"),
    "D/A": ("tripped",),
    "piezo": ("stuck", "limit"),
    "camera": ("frozen", "drops", "saturated"),
    "photodiodes": ("saturated", "loose"),
    "hexapod": ("offset", "stuck", "servos off"),
}
"""Faults of a device whose line is well, by kind of device.

Amplifiers detect a fault of their own, motors do not move, or an encoder reads a wrong angle. A D/A's watchdog
has tripped: its outputs are at their safe voltages, and it refuses every request. A stack has the highest
voltage, or the limit switch is at another voltage. The camera repeats an image, loses half of its frames, or
has all pixels at full scale. Photodiodes are at the end of their range, or one of them is loose and reads 0 V.
The hexapod reports a wrong pose, accepts moves and does not move, or its servos are off.
"""
SILENCE = frozenset(FAULTS) - {"slow"}
"""Faults during which no answer arrives that makes sense."""
OF_SOME_CALLS = (
    *(fault for fault in FAULTS if fault != "unplugged"),
    "encoder",
    "limit",
    "saturated",
    "loose",
    "offset",
)
"""Faults that may meet only some of the calls: those of lines, and single wrong values."""


class SomeCalls:
    """Which calls a fault meets that does not meet each: a fraction of them, or a single one.

    Parameters
    ----------
    random : Random
    part : float
        Fraction of the calls, drawn for each.
    number : int
        If not 0, only this call is met, counted from 1.
    size : float
        As of a fault that meets each call.
    """

    def __init__(self, random: Random, part: float, number: int, size: float) -> None:
        self.size = size
        self._random = random
        self._part = part
        self._number = number
        self._calls = 0

    @property
    def is_seldom(self) -> bool:
        """A device is heard soon enough that fails only in so few calls."""
        return self._number > 0 or self._part <= _SELDOM

    def meets_next(self) -> bool:
        """Whether the next call is met."""
        self._calls += 1
        return self._calls == self._number if self._number else self._random.random() < self._part


class Bus:
    """A :class:`fitctl.drivers.interface.ServoBus`, to which each drive adds what it sends.

    Attributes
    ----------
    meanwhile : callable or None
        Called repeatedly while a drive waits for an answer.
    drives : list of callable
        One for each drive; sends its staged command.
    """

    def __init__(self) -> None:
        self.meanwhile: Callable[[], None] | None = None
        self.drives: list[Callable[[], None]] = []

    def synchronize(self) -> None:
        """Send all staged commands."""
        for send in self.drives:
            send()


class Line:
    """One driver's connection.

    Parameters
    ----------
    device, endpoint : str
        Named in errors.
    time : VirtualTime
    random : Random
    usual_s : float
        Usual duration of an exchange.
    timeout_s : float
        The driver's own time limit.

    Attributes
    ----------
    faults : dict of str to float
        The faults in force, from `FAULTS`. The value of "slow" is the factor.
    at_times : dict of str to SomeCalls
        Those of `OF_SOME_CALLS` that meet only some calls.
    wrong : dict of str to float
        The faults in force, from `WRONG`. The value of "stuck" of a piezo amplifier is the stack, that
        of "loose" the photodiode, that of "encoder" the angle in rad: azimuth's reads too much by it, or
        elevation's too little.
    wrong_until_s : dict of str to float
        When each of those ended last.
    healed_s : float
        When the last fault ended.
    answered_s : float
        When the last of those faults ended during which no answer arrives.
    connected : bool
        Whether the driver has opened the line, and it has not broken since.
    bus : Bus or None
        The bus whose other drives continue while this one waits.
    """

    def __init__(
        self,
        device: str,
        endpoint: str,
        time: VirtualTime,
        random: Random,
        usual_s: float,
        timeout_s: float,
    ) -> None:
        self.device = device
        self.endpoint = endpoint
        self.faults: dict[str, float] = {}
        self.at_times: dict[str, SomeCalls] = {}
        self.wrong: dict[str, float] = {}
        self.wrong_until_s: dict[str, float] = {}
        self.healed_s = self.answered_s = -math.inf
        self.connected = False
        self.bus: Bus | None = None
        self.timeout_s = timeout_s
        self._time = time
        self._random = random
        self._usual_s = usual_s
        self._until_s: dict[tuple[str, bool], float] = {}  # by fault, and whether of some calls

    def begin(
        self, fault: str, lasts_s: float, size: float = 0.0, part: float = 1.0, number: int = 0
    ) -> None:
        """Let a fault be in force for a time; one of the same kind that lasts longer is not cut short.

        It meets each call, a `part` of them, or only the one with this `number`.
        """
        at_times = (part < 1.0 or number > 0) and fault in OF_SOME_CALLS
        if at_times:
            self.at_times[fault] = SomeCalls(self._random, part, number, size)
        elif fault in FAULTS:
            self.faults[fault] = size
        else:
            self.wrong[fault] = size
        until_s = self._time.now_s() + lasts_s
        kind = fault, at_times
        self._until_s[kind] = max(until_s, self._until_s.get(kind, 0.0))
        self._time.call_at(until_s, partial(self._end, kind, until_s))

    def _end(self, kind: tuple[str, bool], until_s: float) -> None:
        fault, at_times = kind
        if self._until_s.get(kind) != until_s:
            return
        if at_times:
            self.at_times.pop(fault, None)
            self.healed_s = self._time.now_s()
            if fault not in FAULTS:
                self.wrong_until_s[fault] = self.healed_s
        else:
            self.heal(fault)

    def heal(self, *faults: str) -> None:
        """End these faults, or all of them, also of some calls, if none is named."""
        self.healed_s = self._time.now_s()
        if not faults:
            self.wrong_until_s |= dict.fromkeys(self.at_times.keys() - set(FAULTS), self.healed_s)
            self.at_times.clear()
        for fault in faults or [*self.faults, *self.wrong]:
            self.faults.pop(fault, None)
            if self.wrong.pop(fault, None) is not None:
                self.wrong_until_s[fault] = self.healed_s
        if not self.faults.keys() & SILENCE:
            self.answered_s = self.healed_s

    def was_wrong(self, fault: str, within_s: float) -> bool:
        """A fault from `WRONG` is in force, at least for some calls, or was until recently."""
        until_s = self.wrong_until_s.get(fault, -math.inf)
        in_force = fault in self.wrong or fault in self.at_times
        return in_force or self._time.now_s() - until_s < within_s

    @property
    def is_bad(self) -> bool:
        """Some calls, or all of them, may fail or take long."""
        return bool(self.faults or self.at_times)

    @property
    def is_readable(self) -> bool:
        """Answers arrive in time, at least most of them."""
        seldom = all(calls.is_seldom for calls in self.at_times.values())
        return self.connected and seldom and not self.faults

    def of_this_call(self) -> dict[str, float]:
        """The faults of one call: those in force, and those that meet it and not each."""
        if not self.at_times:
            return self.faults
        drawn = {
            fault: calls.size
            for fault, calls in self.at_times.items()
            if fault in FAULTS and calls.meets_next()
        }
        return self.faults | drawn

    def wrong_by(self, fault: str) -> float | None:
        """The value of a fault from `WRONG` if the value of one call is wrong in this way, or None."""
        if fault in self.wrong:
            return self.wrong[fault]
        calls = self.at_times.get(fault)
        return calls.size if calls is not None and calls.meets_next() else None

    def is_wrong(self, fault: str) -> bool:
        """Whether the value of one call is wrong in this way."""
        return self.wrong_by(fault) is not None

    @property
    def is_silent(self) -> bool:
        """No answer arrives, or none that makes sense."""
        return not self.connected or bool(self.faults and self.faults.keys() & SILENCE)

    def open(self) -> None:
        """Connect.

        Raises
        ------
        DeviceUnreachable
        """
        if "unplugged" in self.faults:
            self._sleep(self._usual_s)
            raise self._unreachable("nothing")
        self.connected = True

    def close(self) -> None:
        """Disconnect."""
        self.connected = False

    def delay_s(self, faults: dict[str, float]) -> float:
        """Draw the duration of the next exchange."""
        delay_s = self._usual_s * (0.7 + 0.6 * self._random.random())
        return delay_s * faults["slow"] if "slow" in faults else delay_s

    def ask(self, act: Callable[[], Result]) -> Result:
        """Send a request that the device carries out with ``act``, and return its answer.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        if not self.connected:
            raise DeviceUnreachable(
                self.device, self.endpoint, "an open connection", "none", "open it again"
            )
        faults = self.of_this_call()
        if faults:
            return self._ask_badly(act, faults)
        half_s = self.delay_s(faults) / 2
        self._sleep(half_s)
        result = act()
        self._sleep(half_s)
        if not self.connected:  # closed, or reset, meanwhile
            raise self._unreachable("a broken connection")
        return result

    def _ask_badly(self, act: Callable[[], Result], faults: dict[str, float]) -> Result:
        began_s = self._time.now_s()
        if "unplugged" in faults:
            self.connected = False
            self._sleep(self._usual_s)
            raise self._unreachable("a broken connection")
        delay_s = self.delay_s(faults)
        self._sleep(min(delay_s / 2, self.timeout_s))
        if "deaf" in faults or delay_s / 2 > self.timeout_s:
            self._sleep_until(began_s + self.timeout_s)
            raise self.timeout()
        if "refuses" in faults:
            self._sleep(min(delay_s / 2, self.timeout_s))
            raise self.refused()
        result = act()
        if "mute" in faults or delay_s > self.timeout_s:
            self._sleep_until(began_s + self.timeout_s)
            raise self.timeout()
        self._sleep(delay_s / 2)
        if "garbled" in faults:
            raise self.garbled()
        if not self.connected:
            raise self._unreachable("a broken connection")
        return result

    def _sleep(self, duration_s: float) -> None:
        if self.bus is None:
            self._time.sleep(duration_s)
        else:
            self._sleep_until(self._time.now_s() + duration_s)

    def _sleep_until(self, deadline_s: float) -> None:
        """Wait, and meanwhile let the bus's other drives run."""
        bus = self.bus
        while bus is not None and bus.meanwhile is not None and self._time.now_s() < deadline_s:
            self._time.sleep_until(min(deadline_s, self._time.now_s() + _SLICE_S))
            bus.meanwhile()
        self._time.sleep_until(deadline_s)

    def timeout(self) -> DeviceTimeout:
        """The error for an answer that did not arrive in time."""
        return DeviceTimeout(
            self.device, self.endpoint, f"an answer within {self.timeout_s:g} s", "none", "check it"
        )

    def refused(self) -> DeviceRefused:
        """The error for a device that will not obey."""
        return DeviceRefused(self.device, self.endpoint, "to obey", "a refusal", "ask it why")

    def garbled(self) -> DeviceProtocolError:
        """The error for an answer that makes no sense; it also closes the line."""
        self.connected = False
        return DeviceProtocolError(
            self.device, self.endpoint, "an answer", "nonsense", "check the line"
        )

    def broken(self) -> DeviceUnreachable:
        """The error for a broken line; it also closes the line."""
        self.connected = False
        return self._unreachable("a broken connection")

    def _unreachable(self, got: str) -> DeviceUnreachable:
        return DeviceUnreachable(self.device, self.endpoint, "an answer", got, "check its cable")


def drawn_slowness(random: Random) -> float:
    """Draw a factor for "slow", from 1 to 1000."""
    return math.pow(10.0, 3.0 * random.random())


def identity(model: str) -> DeviceIdentity:
    """Who a device of the swarm says it is."""
    return DeviceIdentity("fitctl", f"swarm {model}", "", "")
