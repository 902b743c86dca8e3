"""The siderostat's two amplifiers: an Aerotech Ensemble in free run, commanded over its ASCII interface.

The controller closes a position loop about a trajectory of its own; a velocity command (FREERUN) says how
fast that trajectory runs. The servo above sees angles and commands velocities as with any other back end,
so that it takes out what the trajectories do not.

A free run has no end: when we are gone the motors go on, up to the controller's software limits. Therefore
a controller without them is refused, and so is an axis that is not homed or whose fault masks leave them out:
there the limits may not act. `software_limits_verified` is for a controller on which they have been tried.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial

from fitctl.config import EnsembleDevice, Siderostat
from fitctl.drivers.amplifiers import AXES, LinkedAmplifiers
from fitctl.drivers.ensemble.link import EnsembleLink
from fitctl.drivers.ensemble.protocol import (
    FAULT_MASKS,
    AxisStatus,
    Parameter,
    Reply,
    decimals,
    fault_text,
    parse_bits,
    parse_number,
    why_limits_may_not_act,
)
from fitctl.drivers.interface import (
    AzEl,
    DeviceFault,
    DeviceIdentity,
    DeviceMismatch,
    ServoReading,
)
from fitctl.drivers.plausibility import MotionCheck
from fitctl.drivers.probe import Probe, round_trip_s

_POLL_S = 0.005


class EnsembleAmplifiers(LinkedAmplifiers[EnsembleLink, EnsembleDevice]):
    """Both axes' amplifiers (:class:`fitctl.drivers.interface.ServoAmplifiers`).

    Parameters
    ----------
    siderostat : Siderostat[EnsembleDevice]
        Encoder, limits and device settings of the rig.
    """

    def __init__(self, siderostat: Siderostat[EnsembleDevice]) -> None:
        super().__init__(siderostat, siderostat.device.port)
        self._acceleration_limit_rad_s2 = siderostat.acceleration_limit_rad_s2
        self._counts_per_rad = siderostat.encoder_counts_per_rev / (2 * math.pi)
        self._rad_per_unit = [1.0, 1.0]
        self._digits = [1, 1]
        self._sent: list[str] = ["", ""]
        self._status = [0, 0]
        self._faults = [0, 0]
        self._turn = 0
        self._motion = MotionCheck(
            siderostat.velocity_limit_rad_s, 2 * math.pi / siderostat.encoder_counts_per_rev
        )

    def open(self) -> DeviceIdentity:
        """Connect, check both axes and stop them; nothing moves afterwards.

        Raises
        ------
        DeviceMismatch
            An axis has no encoder counts, or no software limits that are known to act.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        with self._connected(EnsembleLink(self._device)) as link:
            identity = link.probe()
            for axis in range(2):
                self._set_up(axis)
            self._command("WAIT MODE NOWAIT")
            self._motion.restart()
        return identity

    def enable(self) -> None:
        """Power both axes, standing still.

        Raises
        ------
        DeviceFault
            An axis is in fault or does not come up in time; then neither has power.
        """
        self._opened().last_words = tuple(f"ABORT {self._at(axis)}" for axis in range(2))
        with self._disabled_on_failure():
            for axis in range(2):
                self._sent[axis] = ""
                if self._opened().command(f"ENABLE {self._at(axis)}") is not Reply.DONE:
                    raise self._axis_fault(axis, "enabled", "the controller refuses")
                self._wait(axis, "enabled", partial(self._is_enabled, axis))

    def disable(self) -> None:
        """Stop both axes, then take their power; a latched fault stays.

        Raises
        ------
        DeviceFault
            An axis keeps its power; the other one has been disabled all the same.
        """
        link = self._opened()
        self._sent = ["", ""]
        self._motion.command(time.monotonic(), None)
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
        of the controller; each may take `response_timeout_s`. An answer has neither checksum nor number:
        positions that the motors cannot have reached are dropped, and None is returned.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
            The link broke, or is out of step. A fault of an axis does not raise: the reading has it.
        DeviceFault
            An encoder jumped.
        ValueError
            A velocity is not finite.
        """
        velocity_rad_s = self._limited(velocity_rad_s)
        self._opened()
        powered = all(status & AxisStatus.ENABLED for status in self._status)
        possible = self._motion.command(time.monotonic(), velocity_rad_s if powered else None)
        for axis in range(2):
            self._free_run(axis, velocity_rad_s[axis])
        requested_s = time.monotonic()
        az_rad, el_rad = self._position_rad(0), self._position_rad(1)
        read_s = time.monotonic()
        self._poll_axis(*divmod(self._turn, 2))
        self._turn = (self._turn + 1) % 4
        plausible = self._motion.accept(requested_s, read_s, possible, (az_rad, el_rad))
        self._check_jumped(self._motion, 1.0)
        if not plausible:
            return None
        return ServoReading(
            time_s=(requested_s + read_s) / 2,
            position_rad=(az_rad, el_rad),
            enabled=all(status & AxisStatus.ENABLED for status in self._status),
            fault="; ".join(
                f"{name}: {fault}"
                for axis, name in enumerate(AXES)
                if (fault := self._fault_of(axis))
            ),
        )

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
        if not self._device.software_limits_verified:
            masks = (int(self._parameter(axis, mask)) for mask in FAULT_MASKS)
            if why := why_limits_may_not_act(self._status[axis], *masks):
                raise self._mismatch(axis, "software limits that act", why)

    def _fault_of(self, axis: int) -> str:
        if self._faults[axis]:
            return fault_text(self._faults[axis])
        unhomed = not self._status[axis] & AxisStatus.HOMED
        return "not homed" if unhomed and not self._device.software_limits_verified else ""

    def _free_run(self, axis: int, velocity_rad_s: float) -> None:
        """Command a velocity, unless it is the last one commanded."""
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

    def _poll_axis(self, axis: int, what: int) -> None:
        """Read the status or the faults of an axis; both where it has just lost its power."""
        was_enabled = self._status[axis] & AxisStatus.ENABLED
        if what or (was_enabled and not self._is_enabled(axis)):
            self._read_faults(axis)
        elif not was_enabled:
            self._is_enabled(axis)

    def _position_rad(self, axis: int) -> float:
        return self._number(f"PFBKPROG({self._at(axis)})") * self._rad_per_unit[axis]

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

    def _mismatch(self, axis: int, expected: str, got: str) -> DeviceMismatch:
        hint = "set them in the controller, or home it, with its maker's tool"
        return self._endpoint.error(DeviceMismatch, f"{AXES[axis]}: {expected}", got, hint)

    def _axis_fault(self, axis: int, goal: str, got: str) -> DeviceFault:
        faults = fault_text(self._read_faults(axis))
        got = f"{got}; {faults}" if faults else got
        hint = "remove its cause, in the controller with its maker's tool if need be; then recover"
        return self._endpoint.error(DeviceFault, f"{AXES[axis]} {goal}", got, hint)


def probe_ensemble(siderostat: Siderostat[EnsembleDevice]) -> Probe:
    """Whether a controller has both axes, their software limits, and no fault.

    Raises
    ------
    DeviceError
        If it does not answer, or has no such axes.
    """
    device = siderostat.device
    disagreements = []
    with closing(EnsembleLink(device)) as link:
        identity = link.probe()
        for axis in device.axes:
            low, high = (
                link.value(f"GETPARM(@{axis}, {parameter.value})", parse_number)
                for parameter in (Parameter.SOFTWARE_LIMIT_LOW, Parameter.SOFTWARE_LIMIT_HIGH)
            )
            if low >= high:
                disagreements.append(
                    f"axis @{axis} has no software limits: set SoftwareLimitLow and SoftwareLimitHigh"
                )
            elif not device.software_limits_verified:
                masks = (
                    int(link.value(f"GETPARM(@{axis}, {mask.value})", parse_number))
                    for mask in FAULT_MASKS
                )
                status = link.value(f"AXISSTATUS(@{axis})", parse_bits)
                if why := why_limits_may_not_act(status, *masks):
                    disagreements.append(
                        f"axis @{axis} has software limits that may not act ({why}): home it, and set"
                        " FaultMask and FaultMaskDecel"
                    )
            faults = link.value(f"AXISFAULT(@{axis})", parse_bits)
            if faults:
                disagreements.append(
                    f"axis @{axis} is in fault ({fault_text(faults)}): remove its cause"
                )
        question_s = round_trip_s(lambda: link.query(f"PFBKPROG(@{device.axes[0]})"))
    return Probe(identity, question_s, tuple(disagreements))
