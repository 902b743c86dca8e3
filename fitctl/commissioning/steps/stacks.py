"""D/A and piezo amplifier: each channel a small step, seen in the amplifier's own readback."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.daemon.devices import dac_of, piezo_of
from fitctl.drivers.interface import DeviceError, MirrorDac, PiezoAmplifier
from fitctl.processes import signals_ignored

Floats = NDArray[np.float64]
STEP_V = 0.3
_SETTLE_S = 0.2
_REWRITE_S = 0.1  # a D/A's own watchdog wants writes
_TICK_S = 0.02  # between the voltages of a slow way
_FOLLOWS = 0.15  # relative; what the amplifier reads back is good to a few per cent of a step
_MOVED = 0.15  # of a step; less is nothing
_NAMES = ("stack 1", "stack 2", "stack 3")


class Stacks:
    """The mirror's three stacks, by the D/A, with the amplifier's readback.

    Parameters
    ----------
    dac : MirrorDac
    piezo : PiezoAmplifier
    clock : Clock

    Attributes
    ----------
    volts : array, shape (3,)
        What the D/A was last sent.
    furthest_v : float
        The largest distance from where it was at first.
    """

    def __init__(self, dac: MirrorDac, piezo: PiezoAmplifier, clock: Clock) -> None:
        self._dac, self._piezo, self._clock = dac, piezo, clock
        self.at_first_v = self.volts = dac.read_v()
        self.furthest_v = 0.0

    def set(self, volts: Floats) -> None:
        """Set all three at once."""
        self.volts = volts
        self.furthest_v = max(self.furthest_v, float(np.max(np.abs(volts - self.at_first_v))))
        self._dac.send_v(volts)
        self._dac.confirm()

    def keep(self, for_s: float) -> None:
        """Leave them where they are for a time; written again and again, for the D/A's watchdog."""
        until_s = self._clock.now_s() + for_s
        while (left_s := until_s - self._clock.now_s()) > 0:
            self._clock.sleep_until(self._clock.now_s() + min(left_s, _REWRITE_S))
            self.set(self.volts)

    def slew(self, volts: Floats, v_per_s: float) -> None:
        """Go there slowly."""
        while np.any(apart := volts - self.volts):
            most_v = v_per_s * _TICK_S
            self.set(self.volts + np.clip(apart, -most_v, most_v))
            self._clock.sleep_until(self._clock.now_s() + _TICK_S)

    def measured_v(self) -> Floats:
        """What the amplifier reads back, once it has settled."""
        self.keep(_SETTLE_S)
        return self._piezo.stack_volts()


@contextmanager
def opened(site: Site) -> Iterator[Stacks]:
    """The stacks of a loop; afterwards they are where they were, as far as the D/A answers.

    Raises
    ------
    StepError
        If a device fails, or the amplifier's limits are not the rig file's.
    """
    fsm = site.loop.fsm
    dac, piezo = dac_of(fsm.dac), piezo_of(fsm.piezo)
    try:
        piezo.open()
        dac.open()
        stacks = Stacks(dac, piezo, site.clock)
        try:
            yield stacks
            stacks.slew(stacks.at_first_v, fsm.slew_v_per_s)
        except BaseException:  # also an interrupt of the way back
            with signals_ignored(), contextlib.suppress(DeviceError):
                stacks.slew(stacks.at_first_v, fsm.slew_v_per_s)
            raise
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        dac.close()
        piezo.close()


def moves(site: Site) -> str:
    """What the step moves."""
    fsm = site.loop.fsm
    at_stack = STEP_V * fsm.piezo.gain
    return f"each stack by {STEP_V:g} V at the D/A, {at_stack:g} V at the stack, and back"


def check_stacks(site: Site) -> Outcome:
    """Compare what the amplifier reads with what the D/A holds; then step each channel.

    Raises
    ------
    StepError
        At the first thing that is not as expected and that no key of the rig file puts right.
    """
    fsm = site.loop.fsm
    gain = fsm.piezo.gain
    with opened(site) as stacks:
        at_rest_v = stacks.measured_v()
        figures = {
            f"{name} offset_v": float(measured - gain * held)
            for name, measured, held in zip(_NAMES, at_rest_v, stacks.volts, strict=True)
        }
        _refuse_at_rest(site, stacks.volts, at_rest_v, figures)
        response = np.array([_step(site, stacks, stack, gain) for stack in range(3)]).T
        figures["furthest_v"] = stacks.furthest_v
    order = _order(response, figures)
    lines = [
        f"{_NAMES[stack]}: its D/A channel moves {_NAMES[order[stack]]} by "
        f"{response[order[stack], stack]:+.2f} of "
        f"gain {gain:g}"
        for stack in range(3)
    ]
    _refuse_gains(response, order, fsm.dac.full_scale_v, gain, figures)
    if order == [0, 1, 2]:
        return Outcome(lines, figures)
    straight = fsm.dac.channels or [1, 2, 3]
    channels = [straight[order.index(stack)] for stack in range(3)]
    return Outcome(lines, figures, site.found(fsm={"dac": {"channels": channels}}))


def _step(site: Site, stacks: Stacks, stack: int, gain: float) -> Floats:
    """What each stack did, of what was commanded of one."""
    site.report(f"{_NAMES[stack]}: a step of {STEP_V:g} V and back")
    before_v = stacks.measured_v()
    held_v = stacks.volts.copy()
    full_v = site.loop.fsm.dac.full_scale_v
    way = 1.0 if held_v[stack] + STEP_V <= full_v else -1.0
    stacks.set(held_v + way * STEP_V * np.eye(3)[stack])
    stepped_v = stacks.measured_v()
    stacks.set(held_v)
    return (stepped_v - before_v) / (way * STEP_V * gain)


def _refuse_at_rest(
    site: Site, held_v: Floats, measured_v: Floats, figures: dict[str, float]
) -> None:
    """Raise StepError where the stacks are not where the D/A holds them, before anything moves."""
    fsm = site.loop.fsm
    expected_v = fsm.piezo.gain * held_v
    apart_v = measured_v - expected_v
    if np.max(np.abs(apart_v)) <= fsm.piezo.follow_tolerance_v:
        return
    counts = np.rint(held_v / fsm.dac.step_v).astype(int)
    swapped_v = ((counts & 0xFF) << 8 | counts >> 8) * fsm.dac.step_v * fsm.piezo.gain
    tolerance_v = fsm.piezo.follow_tolerance_v
    said = f"the stacks are at {_listed(measured_v)} V and the D/A holds them at {_listed(expected_v)} V"
    if fsm.dac.bits == 16 and np.max(np.abs(measured_v - swapped_v)) <= tolerance_v:
        cause = "this is what the D/A gives if it takes the low byte of a register first: set its byte order"
    elif np.ptp(measured_v / np.maximum(expected_v, 1.0)) < _FOLLOWS:
        part = float(np.mean(measured_v / np.maximum(expected_v, 1.0)))
        cause = (
            f"all are {part:.2f} of that. Either the D/A gives "
            f"{part * fsm.dac.full_scale_v:.3g} V at full scale and "
            f"dac.full_scale_v says {fsm.dac.full_scale_v:g}, or the amplifier's gain is "
            f"{part * fsm.piezo.gain:.3g} and "
            f"piezo.gain says {fsm.piezo.gain:g}; measure the D/A's output with a voltmeter"
        )
    else:
        wrong = [_NAMES[k] for k in range(3) if abs(apart_v[k]) > tolerance_v]
        cause = (
            f"{' and '.join(wrong)}: check the cable from the D/A to the amplifier, the "
            "channel's gain, and its front "
            "knob, which adds to the output"
        )
    raise StepError(f"{said}; {cause}", figures)


def _order(response: Floats, figures: dict[str, float]) -> list[int]:
    """Which stack each channel moves."""
    order = [int(np.argmax(np.abs(response[:, stack]))) for stack in range(3)]
    for stack in range(3):
        moved = np.abs(response[:, stack])
        if moved.max() < _MOVED:
            msg = f"{_NAMES[stack]}: no output followed its step; check the cable from the D/A to the amplifier"
            raise StepError(msg, figures)
        if np.sort(moved)[-2] > _MOVED:
            msg = (
                f"{_NAMES[stack]}: two outputs followed its step; check the cables from the D/A "
                "to the amplifier"
            )
            raise StepError(msg, figures)
    if len(set(order)) < 3:
        msg = "two channels of the D/A move the same output; check the cables from the D/A to the amplifier"
        raise StepError(msg, figures)
    return order


def _refuse_gains(
    response: Floats, order: list[int], full_scale_v: float, gain: float, figures: dict[str, float]
) -> None:
    """Raise StepError where an output follows by another gain, or the other way."""
    followed = np.array([response[order[stack], stack] for stack in range(3)])
    for stack in range(3):
        figures[f"{_NAMES[stack]} gain"] = float(followed[stack] * gain)
    if np.any(followed < 0):
        wrong = [_NAMES[stack] for stack in range(3) if followed[stack] < 0]
        msg = f"{' and '.join(wrong)}: the output goes down when the D/A goes up; exchange the input's poles"
        raise StepError(msg, figures)
    if np.all(np.abs(followed - 1) <= _FOLLOWS):
        return
    if np.ptp(followed) < _FOLLOWS:
        part = float(np.mean(followed))
        msg = (
            f"all outputs follow with {part:.2f} of what is expected: the D/A gives "
            f"{part * full_scale_v:.3g} V at full "
            f"scale and dac.full_scale_v says {full_scale_v:g}, or the amplifier's gain is "
            f"{part * gain:.3g} and "
            f"piezo.gain says {gain:g}; measure the D/A's output with a voltmeter"
        )
        raise StepError(msg, figures)
    wrong = [_NAMES[stack] for stack in range(3) if abs(followed[stack] - 1) > _FOLLOWS]
    msg = (
        f"{' and '.join(wrong)}: the output follows with a gain of "
        f"{', '.join(f'{gain * followed[_NAMES.index(name)]:.3g}' for name in wrong)}, "
        f"expected {gain:g}; check the "
        "channel's gain and whether something loads the D/A's output"
    )
    raise StepError(msg, figures)


def _listed(volts: Floats) -> str:
    return ", ".join(f"{one:.1f}" for one in volts)
