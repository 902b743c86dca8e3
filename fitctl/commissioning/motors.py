"""Small motions of a siderostat's motors, watched reading by reading: before any servo is trusted.

Each motion has a bound. As soon as an encoder has moved further, or an amplifier reports a fault, both motors
are commanded to stand and lose their power.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fitctl.clock import Clock
from fitctl.commissioning.outcome import Site, StepError
from fitctl.daemon.devices import amplifiers_of
from fitctl.drivers.amplifiers import AXES
from fitctl.drivers.interface import AzEl, DeviceError, DeviceFault, ServoAmplifiers

_STILL = (0.0, 0.0)
_BLIND_S = 0.25  # without a reading for so long, nobody watches


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
        As the encoders were last read.
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
                f"the amplifiers report a fault: {reading.fault}. Where the motor turned by itself just "
                "before, its encoder counts against it: exchange the encoder's A and B lines, or set its "
                "direction in the amplifier"
            )
            raise StepError(msg)

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


@contextmanager
def powered(site: Site) -> Iterator[Motors]:
    """A siderostat's motors with power inside, standing; without it afterwards, whatever happens.

    Raises
    ------
    StepError
        If a device fails; its text is the device's own.
    """
    siderostat = site.rig.loops[site.name].siderostat
    amplifiers = amplifiers_of(siderostat)
    motors = Motors(amplifiers, 1 / siderostat.servo.rate_hz, site.clock)
    try:
        amplifiers.open()
        amplifiers.enable()
        yield motors
        amplifiers.exchange(_STILL)
    except DeviceFault as error:
        msg = (
            f"{error}. Where a motor ran away by itself, its encoder counts against it: exchange the encoder's "
            "A and B lines, or set its direction in the amplifier"
        )
        raise StepError(msg) from None
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        with contextlib.suppress(DeviceError):
            amplifiers.exchange(_STILL)
        amplifiers.close()


def axis_name(axis: int) -> str:
    """What people call it."""
    return AXES[axis]
