"""Amplifiers and encoders: stand still, then each motor a pulse, counted by the encoders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.motors import Motors, axis_name, powered
from fitctl.config import BalAnalogDevice
from fitctl.config.wiring import STRAIGHT

PULSE_RAD = 0.03
PULSE_S = 0.15
STOP_RAD = 0.04  # a motor ten times too fast turns on for two periods of the servo
BOUND_RAD = 0.05
STAND_S = 0.4
_STANDS_RAD = 0.015
_SETTLE_S = 0.1
_MOVED = 0.2  # of a pulse; less is no motion
_AS_COMMANDED = 0.25  # relative; a pulse has some twenty counts
_SYMMETRIC = 0.4


def moves(_site: Site) -> str:
    """What the step moves."""
    speed = PULSE_RAD / PULSE_S
    return f"each motor by {PULSE_RAD:g} rad and back, at {speed:g} rad/s; stopped at {BOUND_RAD:g} rad"


def check_amplifiers(site: Site) -> Outcome:
    """Power both motors, see that they stand, and give each a pulse both ways.

    Raises
    ------
    StepError
        At the first thing that is not as expected and that no key of the rig file puts right.
    """
    siderostat = site.rig.loops[site.name].siderostat
    with powered(site) as motors:
        _stands(motors)
        response = np.array([_pulse(motors, axis, site) for axis in range(2)]).T
    figures = {
        "count_rad": siderostat.encoder_count_rad,
        "furthest_rad": motors.furthest_rad,
    }
    for axis in range(2):
        figures[f"{axis_name(axis)}_counted_per_commanded"] = float(response[axis, axis])
        figures[f"{axis_name(axis)}_counted_on_other"] = float(response[1 - axis, axis])
    _refuse(response, figures, siderostat.encoder_counts_per_rev)
    lines = [
        f"{axis_name(axis)}: counted {response[axis, axis]:+.2f} rad for each commanded radian"
        for axis in range(2)
    ]
    signs = np.sign(np.diag(response))
    if np.all(signs > 0):
        return Outcome(lines, figures)
    turned = [axis_name(axis) for axis in range(2) if signs[axis] < 0]
    lines.append(f"{' and '.join(turned)}: the encoder counts against the commanded velocity")
    return Outcome(lines, figures, _with_signs(site, signs))


def _stands(motors: Motors) -> None:
    motors.exchange((0.0, 0.0))
    at_rad = motors.position_rad
    motors.drive(lambda: (0.0, 0.0), STAND_S, _STANDS_RAD)
    for axis in range(2):
        moved = motors.position_rad[axis] - at_rad[axis]
        if abs(moved) > _STANDS_RAD:
            msg = (
                f"{axis_name(axis)} moved by {moved:+.3f} rad within {STAND_S:g} s although commanded to stand "
                "still; adjust the amplifier's offset, or check its command line and its encoder's direction"
            )
            raise StepError(msg, {"furthest_rad": motors.furthest_rad})


def _pulse(motors: Motors, axis: int, site: Site) -> NDArray[np.float64]:
    """Counted radians of both encoders for each radian commanded on one axis: the mean of both ways."""
    site.report(f"{axis_name(axis)}: a pulse of {PULSE_RAD:g} rad and back")
    found = []
    for way in (1.0, -1.0):
        before = np.array(motors.position_rad)
        velocity = way * PULSE_RAD / PULSE_S
        command = (velocity, 0.0) if axis == 0 else (0.0, velocity)
        elapsed_s = motors.drive(lambda command=command: command, PULSE_S, STOP_RAD)
        motors.stand(_SETTLE_S)
        found.append((np.array(motors.position_rad) - before) / (velocity * elapsed_s))
    forward, back = found
    apart = abs(forward[axis] - back[axis])
    size = abs(forward[axis]) + abs(back[axis])
    if size > 2 * _MOVED and apart > _SYMMETRIC * size:
        msg = (
            f"{axis_name(axis)} turned {forward[axis]:+.2f} rad for a commanded radian one way and "
            f"{back[axis]:+.2f} the other way; check for a stop, a limit switch, a brake or an offset of "
            "the amplifier"
        )
        raise StepError(msg, {"furthest_rad": motors.furthest_rad})
    return (forward + back) / 2


def _refuse(response: NDArray[np.float64], figures: dict[str, float], counts_per_rev: int) -> None:
    """Raise StepError for what no rig file puts right."""
    own, other = np.abs(np.diag(response)), np.abs(response[[1, 0], [0, 1]])
    if np.all(own < _MOVED) and np.all(other > _MOVED):
        msg = (
            "a pulse on azimuth is counted by elevation's encoder, and the other way round: motor cables or "
            "encoder cables are exchanged between the amplifiers' axes; exchange one pair, not both"
        )
        raise StepError(msg, figures)
    for axis in range(2):
        if own[axis] < _MOVED and other[axis] < _MOVED:
            msg = (
                f"{axis_name(axis)}: no encoder counted its pulse: the motor does not turn (power, brake, "
                "enable, cable, a blocked shaft), or its encoder is not connected"
            )
            raise StepError(msg, figures)
        if other[axis] > _MOVED:
            msg = (
                f"{axis_name(axis)}: its pulse was counted by the other axis's encoder too "
                f"({response[1 - axis, axis]:+.2f} rad a radian); check encoder cables and their shields"
            )
            raise StepError(msg, figures)
        ratio = own[axis]
        if abs(ratio - 1) > _AS_COMMANDED:
            msg = (
                f"{axis_name(axis)}: counted {ratio:.3g} rad for each commanded radian. Either the amplifier "
                f"turns the motor {ratio:.3g} times as fast as commanded (its velocity scale), or its encoder "
                f"has {ratio * counts_per_rev:.0f} counts a revolution, and encoder_counts_per_rev says "
                f"{counts_per_rev}. Turn the shaft by hand by one revolution and compare the count; then "
                "correct the one that is wrong"
            )
            raise StepError(msg, figures)


def _with_signs(site: Site, signs: NDArray[np.float64]) -> dict[str, object]:
    siderostat = site.rig.loops[site.name].siderostat
    device = siderostat.device
    if isinstance(device, BalAnalogDevice):
        scale = device.velocity_rad_s_per_v
        az, el = scale.az * signs[0], scale.el * signs[1]
        turned = {"velocity_rad_s_per_v": {"az": float(az), "el": float(el)}}
        return site.found(siderostat={"device": turned})
    wiring = siderostat.wiring or STRAIGHT
    velocity_signs = [int(old * new) for old, new in zip(wiring.velocity_signs, signs, strict=True)]
    turned_wiring = wiring.model_dump() | {"velocity_signs": velocity_signs}
    return site.found(siderostat={"wiring": turned_wiring})
