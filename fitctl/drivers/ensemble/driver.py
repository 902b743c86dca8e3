"""The siderostat's two amplifiers: an Aerotech Ensemble in free run, commanded over its ASCII interface.

The controller closes a position loop about a trajectory of its own; a velocity command (FREERUN) says how
fast that trajectory runs. The servo above sees angles and commands velocities as with any other back end,
so that it takes out what the trajectories do not.

A free run has no end: when we are gone the motors go on, up to the controller's software limits. Therefore
a controller without them is refused.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from functools import partial

from fitctl.config import EnsembleDevice, Siderostat
from fitctl.drivers.amplifiers import AXES, DEVICE, held, reach_rad
from fitctl.drivers.ensemble.link import EnsembleLink
from fitctl.drivers.ensemble.protocol import (
    AxisStatus,
    Parameter,
    Reply,
    decimals,
    fault_text,
    parse_bits,
    parse_number,
)
from fitctl.drivers.interface import (
    AzEl,
    DeviceError,
    DeviceFault,
    DeviceIdentity,
    DeviceMismatch,
    DeviceUnreachable,
    ServoReading,
)

_POLL_S = 0.005


class EnsembleAmplifiers:
    """Both axes' amplifiers (:class:`fitctl.drivers.interface.ServoAmplifiers`).

    Parameters
    ----------
    siderostat : Siderostat[EnsembleDevice]
        Encoder, limits and device settings of the rig.
    """

    def __init__(self, siderostat: Siderostat[EnsembleDevice]) -> None:
        self._device = siderostat.device
        self._velocity_limit_rad_s = siderostat.velocity_limit_rad_s
        self._acceleration_limit_rad_s2 = siderostat.acceleration_limit_rad_s2
        self._counts_per_rad = siderostat.encoder_counts_per_rev / (2 * math.pi)
        self._link: EnsembleLink | None = None
        self._rad_per_unit = [1.0, 1.0]
        self._digits = [1, 1]
        self._sent: list[str] = ["", ""]
        self._status = [0, 0]
        self._faults = [0, 0]
        self._turn = 0
        self._last: tuple[float, AzEl] | None = None

    def open(self) -> DeviceIdentity:
        """Connect, check both axes and stop them; nothing moves afterwards.

        Raises
        ------
        DeviceMismatch
            An axis has no encoder counts or no software limits.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        self._link = EnsembleLink(self._device)
        try:
            identity = self._link.probe()
            for axis in range(2):
                self._set_up(axis)
            self._command("WAIT MODE NOWAIT")
            self._last = None
        except BaseException:
            self._drop()
            raise
        return identity

    def enable(self) -> None:
        """Power both axes, standing still.

        Raises
        ------
        DeviceFault
            An axis is in fault or does not come up in time; then neither has power.
        """
        self._opened().last_words = tuple(f"ABORT {self._at(axis)}" for axis in range(2))
        try:
            for axis in range(2):
                self._sent[axis] = ""
                if self._opened().command(f"ENABLE {self._at(axis)}") is not Reply.DONE:
                    raise self._axis_fault(axis, "enabled", "the controller refuses")
                self._wait(axis, "enabled", partial(self._is_enabled, axis))
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self.disable()
            raise

    def disable(self) -> None:
        """Stop both axes, then take their power; a latched fault stays.

        Raises
        ------
        DeviceFault
            An axis keeps its power; the other one has been disabled all the same.
        """
        link = self._opened()
        self._sent = ["", ""]
        for command in ("ABORT", "DISABLE"):
            for axis in range(2):
                link.command(f"{command} {self._at(axis)}")  # what it did shows in the status
        for axis in range(2):
            self._wait(axis, "disabled", partial(self._is_disabled, axis))

    def reset_fault(self) -> None:
        """Disable both axes and acknowledge their faults.

        Raises
        ------
        DeviceFault
            A fault stays, because its cause does.
        """
        self.disable()
        for axis in range(2):
            if self._read_faults(axis):
                self._opened().command(f"FAULTACK {self._at(axis)}")
                self._wait(axis, "without fault", partial(self._is_well, axis))

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: command both motors where their velocity changes, read both encoders.

        Of status and faults of both axes, one is read a period, in turn. Takes five to seven answers
        of the controller; each may take `response_timeout_s`.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
            The link broke, or is out of step. A fault of an axis does not raise: the reading has it.
        DeviceFault
            An encoder says what no motor can do.
        ValueError
            A velocity is not finite.
        """
        velocity_rad_s = held(velocity_rad_s, self._velocity_limit_rad_s)
        self._opened()
        for axis in range(2):
            self._free_run(axis, velocity_rad_s[axis])
        asked_s = time.monotonic()
        az_rad, el_rad = self._position_rad(0), self._position_rad(1)
        read_s = time.monotonic()
        self._look_after(*divmod(self._turn, 2))
        self._turn = (self._turn + 1) % 4
        self._check_plausible(asked_s, read_s, (az_rad, el_rad))
        return ServoReading(
            time_s=(asked_s + read_s) / 2,
            position_rad=(az_rad, el_rad),
            enabled=all(status & AxisStatus.ENABLED for status in self._status),
            fault="; ".join(
                f"{name}: {fault_text(faults)}"
                for name, faults in zip(AXES, self._faults, strict=True)
                if faults
            ),
        )

    def close(self) -> None:
        """Disable if possible and disconnect; safe to call twice and after a failure."""
        if self._link is None:
            return
        with contextlib.suppress(DeviceError):
            self.disable()
        self._drop()

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    # ------------------------------------------------------------ one axis
    def _set_up(self, axis: int) -> None:
        at = self._at(axis)
        counts_per_unit = self._parameter(axis, Parameter.COUNTS_PER_UNIT)
        if counts_per_unit == 0:
            raise self._mismatch(axis, "encoder counts in a unit (parameter CountsPerUnit)", "0")
        low = self._parameter(axis, Parameter.SOFTWARE_LIMIT_LOW)
        high = self._parameter(axis, Parameter.SOFTWARE_LIMIT_HIGH)
        if low >= high:
            got = f"SoftwareLimitLow {low:g}, SoftwareLimitHigh {high:g}"
            raise self._mismatch(axis, "software limits that end a free run without us", got)
        self._rad_per_unit[axis] = counts_per_unit / self._counts_per_rad
        self._digits[axis] = decimals(counts_per_unit)
        ramp = self._acceleration_limit_rad_s2 / abs(self._rad_per_unit[axis])
        for command in (
            f"ABORT {at}",
            f"DISABLE {at}",
            f"RAMP MODE {at} RATE",
            f"RAMP RATE {at} {ramp:.{self._digits[axis]}f}",
        ):
            self._command(command)
        self._is_enabled(axis)
        self._read_faults(axis)

    def _free_run(self, axis: int, velocity_rad_s: float) -> None:
        """Say a velocity, unless it was the last one said too."""
        units_s = f"{velocity_rad_s / self._rad_per_unit[axis]:.{self._digits[axis]}f}"
        if units_s == self._sent[axis] or not self._status[axis] & AxisStatus.ENABLED:
            return
        self._sent[axis] = units_s
        link, command = self._opened(), f"FREERUN {self._at(axis)} {units_s}"
        reply = link.command(command)
        if reply is not Reply.DONE:
            self._sent[axis] = ""
            if not self._read_faults(axis) and self._is_enabled(axis):
                raise link.refused(command, reply)

    def _look_after(self, axis: int, what: int) -> None:
        """Read the status or the faults of an axis; both where it has just lost its power."""
        was_enabled = self._status[axis] & AxisStatus.ENABLED
        if what or (was_enabled and not self._is_enabled(axis)):
            self._read_faults(axis)
        elif not was_enabled:
            self._is_enabled(axis)

    def _position_rad(self, axis: int) -> float:
        return self._number(f"PFBKPROG({self._at(axis)})") * self._rad_per_unit[axis]

    def _check_plausible(self, asked_s: float, read_s: float, position_rad: AzEl) -> None:
        """An ASCII answer has no checksum and no number of its own: see that it can be this one."""
        last, self._last = self._last, (asked_s, position_rad)
        if last is None:
            return
        since_s, before_rad = read_s - last[0], last[1]
        most_rad = reach_rad(self._velocity_limit_rad_s, since_s)
        for name, before, now in zip(AXES, before_rad, position_rad, strict=True):
            if abs(now - before) > most_rad:
                raise DeviceFault(
                    DEVICE,
                    self._device.port,
                    f"{name} to turn at most {most_rad:.2f} rad in {since_s:.3f} s",
                    f"{now - before:.2f} rad",
                    "check the encoder and its cable, then recover",
                )

    def _is_enabled(self, axis: int) -> bool:
        self._status[axis] = self._bits(f"AXISSTATUS({self._at(axis)})")
        return bool(self._status[axis] & AxisStatus.ENABLED)

    def _is_disabled(self, axis: int) -> bool:
        return not self._is_enabled(axis)

    def _is_well(self, axis: int) -> bool:
        return not self._read_faults(axis)

    def _read_faults(self, axis: int) -> int:
        self._faults[axis] = self._bits(f"AXISFAULT({self._at(axis)})")
        return self._faults[axis]

    def _wait(self, axis: int, goal: str, reached: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + self._device.response_timeout_s
        while not reached():
            if time.monotonic() > deadline_s:
                waited = f"not within {self._device.response_timeout_s:g} s"
                raise self._axis_fault(axis, goal, waited)
            time.sleep(_POLL_S)

    # ------------------------------------------------------------ commands and errors
    def _at(self, axis: int) -> str:
        return f"@{self._device.axes[axis]}"

    def _parameter(self, axis: int, parameter: Parameter) -> float:
        return self._number(f"GETPARM({self._at(axis)}, {parameter.value})")

    def _command(self, text: str) -> None:
        link = self._opened()
        reply = link.command(text)
        if reply is not Reply.DONE:
            raise link.refused(text, reply)

    def _number(self, text: str) -> float:
        return self._opened().value(text, parse_number)

    def _bits(self, text: str) -> int:
        return self._opened().value(text, parse_bits)

    def _opened(self) -> EnsembleLink:
        if self._link is None:
            expected = "an open connection"
            raise DeviceUnreachable(DEVICE, self._device.port, expected, "none", "open it again")
        return self._link

    def _mismatch(self, axis: int, expected: str, got: str) -> DeviceMismatch:
        hint = "set them in the controller with its maker's tool"
        what = f"{AXES[axis]}: {expected}"
        return DeviceMismatch(DEVICE, self._device.port, what, got, hint)

    def _axis_fault(self, axis: int, goal: str, got: str) -> DeviceFault:
        faults = fault_text(self._read_faults(axis))
        return DeviceFault(
            DEVICE,
            self._device.port,
            f"{AXES[axis]} {goal}",
            f"{got}; {faults}" if faults else got,
            "remove its cause, then recover",
        )
