"""Small motions of a siderostat's motors, watched reading by reading: before any servo is trusted.

Each motion has a bound. As soon as an encoder has moved further, or an amplifier reports a fault, both motors
are commanded to stand and lose their power.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps.ending import stopped_early
from fitctl.daemon.devices import amplifiers_of
from fitctl.drivers.amplifiers import AXES
from fitctl.drivers.interface import AzEl, DeviceError, DeviceFault, ServoAmplifiers

Floats = NDArray[np.float64]
_STILL = (0.0, 0.0)
MOST_RAD_S = 4.0
_GAIN_PER_S = 15.0
_THERE_RAD = 0.01
_AWAY_RAD = 0.2
_BLIND_S = 0.25  # without a reading for so long, nobody watches
_MAY_HAVE_POWER = "a motor may still have power: press the emergency stop"


class Motors:
    """Both motors with power, commanded by velocity, watched by their encoders.

    Parameters
    ----------
    amplifiers : ServoAmplifiers
        Open, and enabled.
    period_s : float
        Between two exchanges.
    clock : Clock

    Attributes
    ----------
    position_rad : pair of float
        As the encoders were last read; zero before :meth:`wait_for_reading`.
    furthest_rad : float
        The largest angle of an encoder from where it was at first.
    """

    def __init__(self, amplifiers: ServoAmplifiers, period_s: float, clock: Clock) -> None:
        self._amplifiers = amplifiers
        self._clock = clock
        self._period_s = period_s
        self._next_s = self._clock.now_s()
        self.position_rad: AzEl = (0.0, 0.0)
        self._at_first_rad: AzEl | None = None
        self._read_s = self._next_s
        self.furthest_rad = 0.0

    def exchange(self, velocity_rad_s: AzEl) -> None:
        """One servo period; raises StepError where an amplifier reports a fault or nothing is read."""
        self._clock.sleep_until(self._next_s)
        self._next_s = max(self._next_s + self._period_s, self._clock.now_s())
        reading = self._amplifiers.exchange(velocity_rad_s)
        if reading is None:
            if self._clock.now_s() > self._read_s + _BLIND_S:
                msg = (
                    f"the encoders gave no usable reading for {_BLIND_S:g} s while a motor was commanded; "
                    "check the encoders and the link to the amplifiers"
                )
                raise StepError(msg)
            return
        self._read_s = self._clock.now_s()
        self.position_rad = reading.position_rad
        if self._at_first_rad is None:
            self._at_first_rad = reading.position_rad
        self.furthest_rad = max(
            self.furthest_rad,
            *(abs(a - b) for a, b in zip(reading.position_rad, self._at_first_rad, strict=True)),
        )
        if reading.fault:
            msg = (
                f"the amplifiers report a fault: {reading.fault}. Where the motor did not turn as commanded, "
                "look for a mechanical end, a brake or a limit of the amplifier. Where it turned by itself, "
                "its encoder counts against it: exchange the encoder's A and B lines, or set its direction in "
                "the amplifier"
            )
            raise StepError(msg)

    def wait_for_reading(self) -> None:
        """Command zero velocity until the encoders have been read once; StepError if they cannot be."""
        self._next_s = self._read_s = self._clock.now_s()
        while self._at_first_rad is None:
            self.exchange(_STILL)

    def stand(self, for_s: float) -> None:
        """Command zero velocity for a time."""
        self.drive(lambda: _STILL, for_s, float("inf"))

    def drive(self, velocity_rad_s: Callable[[], AzEl], for_s: float, bound_rad: float) -> float:
        """Command velocities for a time, or until an encoder has moved by `bound_rad`; returns how long."""
        began_s = self._clock.now_s()
        at_rad = self.position_rad
        while (elapsed_s := self._clock.now_s() - began_s) < for_s:
            self.exchange(velocity_rad_s())
            if max(abs(a - b) for a, b in zip(self.position_rad, at_rad, strict=True)) > bound_rad:
                elapsed_s = self._clock.now_s() - began_s
                break
        self.exchange(_STILL)
        return elapsed_s


class Servo:
    """Both motors held at angles of their encoders, by whoever calls :meth:`hold` often enough.

    Parameters
    ----------
    site : Site
    motors : Motors

    Attributes
    ----------
    goal_rad : array, shape (2,)
        Where they were last sent; at first where they are.
    """

    def __init__(self, site: Site, motors: Motors) -> None:
        self._site, self._motors = site, motors
        self._most_rad_s = within_limit(site, MOST_RAD_S)
        motors.exchange(_STILL)
        self.goal_rad = np.array(motors.position_rad)

    def hold(self) -> None:
        """One period."""
        apart = self.goal_rad - self._motors.position_rad
        az, el = np.clip(_GAIN_PER_S * apart, -self._most_rad_s, self._most_rad_s).tolist()
        self._motors.exchange((az, el))

    def turn_to(self, goal_rad: Floats) -> None:
        """Turn both motors to an angle of their encoders, slowly.

        Raises
        ------
        StepError
            If one does not get there, or goes the other way, or the angle is beyond the travel.
        """
        motors = self._motors
        self.goal_rad = np.array(goal_rad, dtype=float)
        travel_rad = self._site.rig.loops[self._site.name].siderostat.travel_rad
        if np.max(np.abs(self.goal_rad)) > travel_rad:
            msg = (
                f"({goal_rad[0]:.1f}, {goal_rad[1]:.1f}) rad is beyond the travel of "
                f"{travel_rad:.1f} rad from the "
                "encoders' zero; bring the siderostat nearer to its middle"
            )
            raise StepError(msg)
        began_rad = np.array(motors.position_rad)
        way_rad = np.max(np.abs(self.goal_rad - began_rad))
        until_s = self._site.clock.now_s() + 2 * way_rad / self._most_rad_s + 2.0
        while np.max(np.abs(self.goal_rad - motors.position_rad)) > _THERE_RAD:
            self.hold()
            apart_rad = np.max(np.abs(self.goal_rad - motors.position_rad))
            if apart_rad > way_rad + _AWAY_RAD:
                msg = "a motor moves away from its set-point; repeat the step amplifiers"
                raise StepError(msg)
            if self._site.clock.now_s() > until_s:
                at = ", ".join(f"{one:.2f}" for one in motors.position_rad)
                msg = (
                    f"the motors are at ({at}) rad and were sent to "
                    f"({self.goal_rad[0]:.2f}, {self.goal_rad[1]:.2f}) rad: one does not "
                    "follow; check for a stop or "
                    "a limit of the amplifier"
                )
                raise StepError(msg)


@contextmanager
def powered(site: Site) -> Iterator[Motors]:
    """A siderostat's motors with power inside, standing; without it afterwards, whatever happens.

    Raises
    ------
    StepError
        If a device fails; its text is the device's own. If a motor may still have power, the text says so.
    """
    siderostat = site.rig.loops[site.name].siderostat
    amplifiers = amplifiers_of(siderostat)
    motors = Motors(amplifiers, 1 / siderostat.servo.rate_hz, site.clock)
    try:
        amplifiers.open()
        with stopped_early(amplifiers.disable, amplifiers.open, _MAY_HAVE_POWER):
            amplifiers.enable()
            motors.wait_for_reading()
            yield motors
            amplifiers.exchange(_STILL)
            amplifiers.disable()
    except DeviceFault as error:
        msg = (
            f"{error}. Where a motor ran away by itself, its encoder counts against it: exchange the encoder's "
            "A and B lines, or set its direction in the amplifier"
        )
        raise StepError(msg) from None
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        amplifiers.close()


def within_limit(site: Site, velocity_rad_s: float) -> float:
    """A velocity of the motors, or their limit in the rig file if that is lower."""
    return min(velocity_rad_s, site.rig.loops[site.name].siderostat.velocity_limit_rad_s)


def axis_name(axis: int) -> str:
    """What people call it."""
    return AXES[axis]
