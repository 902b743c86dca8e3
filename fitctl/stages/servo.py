"""The siderostat under its position servo: one period at a time, on a thread of its own at 500 Hz.

Everything that speaks to the amplifiers happens inside :meth:`SiderostatServo.period`, so that one thread
only uses the driver; the other threads leave wishes (a set-point, a stop, a request) and read results.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock, Watchdog
from fitctl.config import AnyLoop
from fitctl.controllers.position_servo import position_servo
from fitctl.drivers.interface import (
    AzEl,
    BusAmplifiers,
    DeviceError,
    DeviceFault,
    DeviceIdentity,
    DeviceTimeout,
    ServoAmplifiers,
    ServoReading,
)
from fitctl.stages.journal import NO_MISTAKE

Floats = NDArray[np.float64]
HISTORY_S = 0.3
_REQUEST_TIMEOUT_S = 15.0
_STILL = (0.0, 0.0)
FOLLOWING_S = 0.05
_ENCODER_JUMP_RAD = 0.5  # while nobody looked: more than a motor coasts
_ON_ITS_OWN_S = (
    3.0  # motors may have turned for so long after a supervisor last wrote where they were
)
_LOOK_AGAIN = 0.2  # of the time limit for readings: after a pause of this computer's own
_SPEED_MARGIN = 1.2  # of a motor that turns on, over its last velocity command


class ServoTiming(NamedTuple):
    """Lateness of servo periods since last asked: for timing reports."""

    late_s: list[float]
    missed_readings: int
    skipped: int


class ServoState(NamedTuple):
    """The servo as one tick takes it.

    Attributes
    ----------
    position_rad : array, shape (2,)
        Motor angles as last read.
    reading : ServoReading or None
        What the amplifiers said last; None if nothing since they were opened.
    fault : DeviceError or None
    following_rad : float
        The least following error since last asked; NaN where the motors followed nothing.
    round_trip_s : float
        Of the last exchange with the amplifiers.
    """

    position_rad: Floats
    reading: ServoReading | None
    fault: DeviceError | None
    following_rad: float
    round_trip_s: float

    @property
    def newest_rad(self) -> Floats:
        """Motor angles of the newest reading, shape (2,)."""
        reading = self.reading
        return self.position_rad if reading is None else np.array(reading.position_rad)


class SiderostatServo:
    """One loop's siderostat.

    Parameters
    ----------
    name : str
        Loop name, for errors.
    loop : AnyLoop
    amplifiers : ServoAmplifiers
    clock : Clock
    setpoint_period_s : float
        Time between calls of :meth:`move_to`: the frame period.
    """

    def __init__(
        self,
        name: str,
        loop: AnyLoop,
        amplifiers: ServoAmplifiers,
        clock: Clock,
        setpoint_period_s: float,
    ) -> None:
        siderostat = loop.siderostat
        self.name = name
        self.endpoint = siderostat.device.endpoint
        self.period_s = 1.0 / siderostat.servo.rate_hz
        self.fault: DeviceError | None = None
        self.enabled = False
        self.opened = False
        self.threaded = False
        self.setpoint_rad = np.zeros(2)
        self._settings = siderostat.servo
        self._amplifiers = amplifiers
        self._clock = clock
        self._servo = position_servo(siderostat, setpoint_period_s)
        self._stopped = True
        self._position_rad: AzEl = (0.0, 0.0)
        self._wanted_rad: AzEl | None = None  # written by other threads, never by the servo's
        self._applied_rad: AzEl | None = None  # the newest of those that the servo has read
        self._requests: deque[tuple[Callable[[], DeviceIdentity | None], Future]] = deque()
        self._history: deque[ServoReading] = deque(maxlen=round(HISTORY_S / self.period_s))
        self._blind_s = 1.0 / siderostat.servo.gain_per_s  # an older reading would make it swing
        self._read_s = -math.inf
        self._blind = False
        self._timely = Watchdog(
            self._settings.reading_timeout_s, _LOOK_AGAIN * self._settings.reading_timeout_s, 0.0
        )
        self._missed_readings = 0
        self._drained = (0, 0)  # missed and skipped, as last asked
        self._followed_s = 0.0
        self.encoders_jumped = False  # until the loop has concluded from it
        self.turned_on_rad = 0.0
        # When each was sent: the commands that the last reading may not show yet, and the one before them.
        self._unread: list[tuple[float, AzEl]] = []
        self._recalled_rad: AzEl | None = None
        self._velocity_limit_rad_s = siderostat.velocity_limit_rad_s
        self._disabling = False
        self._staged: tuple[float, AzEl] | None = None
        self.late_s: deque[float] = deque(maxlen=4096)
        self.skipped = 0
        self.round_trip_s = 0.0
        self._following_rad: deque[float] = deque(maxlen=4096)

    # ------------------------------------------------------------ from any thread

    @property
    def position_rad(self) -> Floats:
        """Motor angles as last read, shape (2,)."""
        return np.array(self._position_rad)

    @property
    def requested(self) -> bool:
        """Something is asked for that :meth:`serve_requests` does."""
        return bool(self._requests)

    def move_to(self, setpoint_rad: Floats) -> None:
        """Wanted motor angles one set-point period from now, shape (2,)."""
        self.setpoint_rad = setpoint_rad
        az_rad, el_rad = setpoint_rad.tolist()
        self._wanted_rad = (az_rad, el_rad)

    def recall(self, position_rad: AzEl) -> None:
        """Until the encoders are read, they are where they were when another supervisor was killed.

        The first reading is compared with that.
        """
        self._recalled_rad = self._position_rad = position_rad

    def stop(self) -> None:
        """Velocity zero from the next period on, until :meth:`hold`."""
        self._stopped = True
        self._wanted_rad = None

    def hold(self, position_rad: Floats) -> None:
        """Servo about where the motors are, shape (2,), by their newest reading."""
        self.move_to(position_rad)
        self._stopped = False

    def read_state(self) -> ServoState:
        """How it is now; the following error is taken anew from here on."""
        following_rad = math.nan
        for _ in range(len(self._following_rad)):
            following_error_rad = self._following_rad.popleft()
            if not following_rad <= following_error_rad:  # not a number fails this too
                following_rad = following_error_rad
        try:
            reading = self._history[-1]
        except IndexError:  # none since it was opened
            reading = None
        return ServoState(self.position_rad, reading, self.fault, following_rad, self.round_trip_s)

    def position_at(self, time_s: float) -> Floats:
        """Motor angles at a recent time, shape (2,), interpolated between readings."""
        # The newest first: what is asked for is near, and 150 readings are 150 places in memory. One that the
        # servo's thread appends meanwhile has another come twice.
        history, back, after = self._history, 1, None
        try:
            while (before := history[-back]).time_s > time_s:
                back, after = back + 1, before
        except IndexError:
            return np.array(self._position_rad if after is None else after.position_rad)
        before_s, (az_rad, el_rad), *_ = before
        if after is not None:
            after_s, (after_az_rad, after_el_rad), *_ = after
            part = (time_s - before_s) / (after_s - before_s)
            az_rad += part * (after_az_rad - az_rad)
            el_rad += part * (after_el_rad - el_rad)
        return np.array([az_rad, el_rad])

    def open(self) -> DeviceIdentity:
        """Connect, clear a latched fault, read the encoders and enable; the motors stand still."""
        return self._request(self._open)

    def disable(self) -> None:
        """Take power from the motors, without waiting for it; a failure shows as a fault."""
        if self.opened and self.enabled and not self._disabling:
            self._disabling = True
            self._queue_request(self._disable)

    def close(self) -> None:
        """Disable and disconnect."""
        self._request(self._close)

    def drain_timing(self) -> ServoTiming:
        """Lateness, missed readings and skipped periods since the last call."""
        late = [self.late_s.popleft() for _ in range(len(self.late_s))]
        # The servo's thread counts on and on: what it counts meanwhile is in the next difference.
        missed, skipped = self._missed_readings, self.skipped
        before, self._drained = self._drained, (missed, skipped)
        return ServoTiming(late, missed - before[0], skipped - before[1])

    # ------------------------------------------------------------ on the servo's thread

    def period(self) -> None:
        """One servo period: requests, then command and read both axes."""
        self.serve_requests()
        if self.opened:
            asked_s = self._clock.now_s()
            self._exchange(asked_s, self._wanted_rad_s(asked_s))

    def serve_requests(self) -> None:
        """Do what other threads have asked for; it may take seconds."""
        while self._requests:
            action, future = self._requests.popleft()
            try:
                future.set_result(action())
            except Exception as error:
                future.set_exception(error)

    def stage(self) -> None:
        """Begin a period on a shared bus, which :meth:`finish` ends: have the command ready for the bus."""
        if not self.opened:
            return
        asked_s = self._clock.now_s()
        velocity_rad_s = self._wanted_rad_s(asked_s)
        try:
            cast(BusAmplifiers, self._amplifiers).stage(velocity_rad_s)
            self._staged = asked_s, velocity_rad_s
        except Exception as error:
            if self.fault is None:
                self._fail(error)

    def finish(self) -> None:
        """End a period on a shared bus: read both axes."""
        staged, self._staged = self._staged, None
        if staged is not None and self.fault is None:  # the others do not wait for a drive in fault
            self._exchange(*staged)

    def wait(self) -> None:
        """There is always work."""

    def _wanted_rad_s(self, now_s: float) -> AzEl:
        # In a fault, the drive must go on hearing that it shall stand still, and that we live.
        return _STILL if self.fault is not None else self._velocity_rad_s(now_s)

    def _exchange(self, asked_s: float, velocity_rad_s: AzEl) -> None:
        if self.fault is not None:
            with suppress(Exception):
                self._amplifiers.exchange(velocity_rad_s)
            return
        self._unread.append((asked_s, velocity_rad_s))
        try:
            self._servo_by(self._amplifiers.exchange(velocity_rad_s), asked_s)
        except Exception as error:
            self._fail(error)

    def _servo_by(self, reading: ServoReading | None, asked_s: float) -> None:
        now_s = self._clock.now_s()
        self.round_trip_s = now_s - asked_s
        if reading is None:
            self._missed_readings += 1
        else:
            self._accept_reading(reading, now_s)
            # On a slow line a command arrives as late as a reading does.
            shown_s = 2 * reading.time_s - now_s
            while len(self._unread) > 1 and self._unread[1][0] <= shown_s:
                del self._unread[0]
        if self._timely.expired(now_s):
            raise self._no_reading()
        if reading is None:
            return
        if reading.fault:
            hint = "remove its cause, then recover"
            raise DeviceFault(self._device, self.endpoint, "no fault", reading.fault, hint)
        if self.enabled and not reading.enabled:
            got = "an axis disabled itself"
            raise DeviceFault(self._device, self.endpoint, "both axes enabled", got, "recover")
        if self._stopped or not self.enabled:
            self._servo.reset(reading.position_rad)
            return
        if self._blind:
            if now_s - reading.time_s > self._blind_s:
                return  # motors that went on turning unseen have nothing to follow
            self._go_on_from(reading.position_rad)
        following_rad = self._servo.following_error_rad(reading.position_rad)
        self._following_rad.append(following_rad)
        if following_rad <= self._settings.following_error_limit_rad:
            self._followed_s = reading.time_s
        # A reversal at full speed is behind for a moment; a stuck axis stays behind.
        elif reading.time_s - self._followed_s > FOLLOWING_S:
            raise self._not_following(following_rad)

    def _velocity_rad_s(self, now_s: float) -> AzEl:
        wanted_rad = self._wanted_rad  # read once: another thread may replace it at any moment
        is_new = wanted_rad is not self._applied_rad
        self._applied_rad = wanted_rad
        if self._stopped or not self.enabled:
            return _STILL
        if is_new and wanted_rad is not None:
            self._servo.move_to(wanted_rad)
        if now_s - self._read_s > self._blind_s:
            self._blind = True
            return _STILL
        return self._servo.step(self._position_rad)

    def _go_on_from(self, position_rad: AzEl) -> None:
        """Go to the set-point from the present position: without commands, a drive kept its last velocity."""
        self._blind = False
        self._servo.reset(position_rad)
        if self._applied_rad is not None:
            self._servo.move_to(self._applied_rad)

    def _accept_reading(self, reading: ServoReading, now_s: float) -> None:
        self._read_s = reading.time_s
        if now_s - reading.time_s <= self._blind_s:
            self._timely.feed(now_s)
        self._position_rad = reading.position_rad
        self._history.append(reading)

    def _fail(self, error: Exception) -> None:
        self._stopped = True
        if not isinstance(error, DeviceError):
            hint = "report it with the log; recover"
            error = DeviceFault(self._device, self.endpoint, NO_MISTAKE, repr(error), hint)
        self.fault = error

    def _no_reading(self) -> DeviceTimeout:
        return DeviceTimeout(
            self._device,
            self.endpoint,
            f"an encoder reading within {self._settings.reading_timeout_s:g} s, "
            f"at most {self._blind_s * 1e3:.0f} ms old",
            "none",
            "check the drive's power and link, then recover",
        )

    def _not_following(self, following_rad: float) -> DeviceFault:
        return DeviceFault(
            self._device,
            self.endpoint,
            f"following error below {self._settings.following_error_limit_rad:g} rad",
            f"{following_rad:.2f} rad for {FOLLOWING_S * 1e3:.0f} ms",
            "look for a stuck axis, then recover",
        )

    @property
    def _device(self) -> str:
        return f"siderostat {self.name}"

    def _open(self) -> DeviceIdentity:
        self._stopped = True
        self.fault = None
        self.opened = self.enabled = False
        identity = self._amplifiers.open()
        self._amplifiers.reset_fault()
        self._find_position()
        self._amplifiers.enable()
        self.opened = self.enabled = True
        self._timely.feed(self._clock.now_s())
        return identity

    def _find_position(self) -> None:
        """Read the encoders before power is on: nothing is ever servoed about a place never read.

        A drive that stopped answering may have turned on at any velocity that it was sent since; its encoders
        count on from the same zero. Any other difference means that they count from elsewhere now.
        """
        self._timely.feed(self._clock.now_s())
        while (reading := self._amplifiers.exchange(_STILL)) is None:
            if self._timely.expired(self._clock.now_s()):
                raise self._no_reading()
        knew, last_rad, last_s = bool(self._history), self._position_rad, self._read_s
        recalled_rad, self._recalled_rad = self._recalled_rad, None
        self._history.clear()
        self._accept_reading(reading, self._clock.now_s())
        self._servo.reset(reading.position_rad)
        for_s = _SPEED_MARGIN * (reading.time_s - last_s)
        by_axis = list(zip(_STILL, *(rad_s for _, rad_s in self._unread), strict=True))
        least_rad, most_rad = ([for_s * limit(rad_s) for rad_s in by_axis] for limit in (min, max))
        if recalled_rad is not None:
            knew, last_rad = True, recalled_rad
            most_rad = [self._velocity_limit_rad_s * _ON_ITS_OWN_S] * 2
            least_rad = [-rad for rad in most_rad]
        turned_rad = [now - last for now, last in zip(reading.position_rad, last_rad, strict=True)]
        far = knew and max(map(abs, turned_rad)) > _ENCODER_JUMP_RAD
        # After a loss of power they begin at zero, and no motor turns.
        at_zero = max(map(abs, reading.position_rad)) < _ENCODER_JUMP_RAD
        turned_on = not at_zero and all(
            least - _ENCODER_JUMP_RAD <= rad <= most + _ENCODER_JUMP_RAD
            for rad, least, most in zip(turned_rad, least_rad, most_rad, strict=True)
        )
        self._unread.clear()
        self.encoders_jumped = self.encoders_jumped or (far and not turned_on)
        self.turned_on_rad = max(map(abs, turned_rad)) if far and turned_on else 0.0

    def _disable(self) -> None:
        self._stopped = True
        try:
            self._amplifiers.disable()
            self.enabled = False
        except Exception as error:
            self._fail(error)
            raise
        finally:
            self._disabling = False

    def _close(self) -> None:
        self._stopped = True
        self.opened = self.enabled = False
        self._amplifiers.close()

    def _queue_request(self, action: Callable[[], DeviceIdentity | None]) -> Future:
        future: Future = Future()
        self._requests.append((action, future))
        return future

    def _request(self, action: Callable[[], DeviceIdentity | None]) -> DeviceIdentity:
        future = self._queue_request(action)
        if not self.threaded:
            self.period()
        try:
            return future.result(timeout=_REQUEST_TIMEOUT_S)
        except TimeoutError:
            raise DeviceTimeout(
                self._device,
                self.endpoint,
                f"to be done within {_REQUEST_TIMEOUT_S:g} s",
                "nothing",
                "check the drive and its link, then recover",
            ) from None
