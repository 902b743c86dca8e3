"""Several siderostats servoed on one thread.

With a thread each, three servos at 500 Hz and the tick wait for each other more often than for their drives.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from fitctl.clock import Clock
from fitctl.drivers.interface import DeviceError, Devices, ServoBus
from fitctl.stages.servo import SiderostatServo


class ServoGroup:
    """Servos whose amplifiers are on buses; a :class:`~fitctl.stages.periodic.Periodic`.

    A period begins with all servos, synchronizes each bus, and ends with all servos. What one servo may wait
    long for, such as for its amplifiers to open, takes many periods: the others go on meanwhile, as often as
    they are due.

    Parameters
    ----------
    servos : sequence of (SiderostatServo, ServoBus)
        With the same period, each with the bus of its amplifiers.
    clock : Clock

    Attributes
    ----------
    servos : list of SiderostatServo
    """

    def __init__(self, servos: Sequence[tuple[SiderostatServo, ServoBus]], clock: Clock) -> None:
        self.servos = [servo for servo, _ in servos]
        self.period_s = self.servos[0].period_s
        self.late_s: deque[float] = deque(maxlen=4096)
        self._bus_of = dict(servos)
        self._buses = list(dict.fromkeys(self._bus_of.values()))
        self._clock = clock
        self._due_s = 0.0
        self._busy: SiderostatServo | None = None
        self._made_meanwhile = 0

    @property
    def threaded(self) -> bool:
        """A thread runs it, and no request does so by itself."""
        return self.servos[0].threaded

    @threaded.setter
    def threaded(self, threaded: bool) -> None:
        for servo in self.servos:
            servo.threaded = threaded

    @property
    def skipped(self) -> int:
        """Periods that were too late, which all servos missed."""
        return self.servos[0].skipped

    @skipped.setter
    def skipped(self, skipped: int) -> None:
        missed = max(0, skipped - self.skipped - self._made_meanwhile)
        self._made_meanwhile = 0
        for servo in self.servos:
            servo.skipped += missed

    def period(self) -> None:
        """One servo period of all."""
        while self.late_s:
            late_s = self.late_s.popleft()
            for servo in self.servos:
                servo.late_s.append(late_s)
        self._due_s = self._clock.now_s() + self.period_s
        for servo in self.servos:
            if servo.requested:
                self._while_others_go_on(servo, servo.serve_requests)
        self._exchange(self.servos)

    def wait(self) -> None:
        """There is always work."""

    def _exchange(self, servos: Sequence[SiderostatServo]) -> None:
        for servo in servos:
            self._while_others_go_on(servo, servo.stage)
        for bus in self._buses:
            with suppress(DeviceError):  # its servos find that it is gone
                bus.synchronize()
        for servo in servos:
            servo.finish()

    def _while_others_go_on(self, servo: SiderostatServo, action: Callable[[], None]) -> None:
        """Let a servo do what may wait long for its drive: to be opened, or to be asked why it is silent."""
        if self._busy is not None:  # others of a period that is made meanwhile
            action()
            return
        bus = self._bus_of[servo]
        self._busy, bus.meanwhile = servo, self._go_on
        try:
            action()
        finally:
            self._busy = bus.meanwhile = None

    def _go_on(self) -> None:
        """Servo the others while one is busy, if they are due."""
        now_s, busy = self._clock.now_s(), self._busy
        if now_s < self._due_s or busy is None:
            return
        # As in PeriodicThread: a late period shifts none after it, and those that are missed are skipped.
        next_s = self._due_s + self.period_s
        self._due_s = next_s if next_s > now_s else now_s + self.period_s
        self._made_meanwhile += 1
        bus = self._bus_of[busy]
        bus.meanwhile = None
        try:
            self._exchange([servo for servo in self.servos if servo is not busy])
        finally:
            bus.meanwhile = self._go_on


def servo_groups(
    devices: Devices, servos: Mapping[str, SiderostatServo], clock: Clock
) -> list[ServoGroup]:
    """The servos on buses, parted by their periods; `servos` has those of all loops."""
    of_period: dict[float, list[tuple[SiderostatServo, ServoBus]]] = {}
    for name, servo in servos.items():
        bus = devices.loops[name].bus
        if bus is not None:
            of_period.setdefault(servo.period_s, []).append((servo, bus))
    return [ServoGroup(group, clock) for group in of_period.values()]
