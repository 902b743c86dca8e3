"""The travel of a siderostat: each motor to both ends, slowly over the untried part, and back."""

from __future__ import annotations

import math

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.motors import Motors, axis_name, powered, within_limit

OF_TRAVEL = 0.98  # both ends; the software limit itself is the supervisor's
FAST_RAD_S = 12.0
SLOW_RAD_S = 3.0
_SLOW_FROM = 0.85  # of the way to an end
_GAIN_PER_S = 10.0
_THERE_RAD = 0.05
_OTHER_RAD = 0.3  # the axis that stands
_LOOK_S = 0.2
_PART = 0.3  # of what was commanded within that time; less is a stop


def moves(site: Site) -> str:
    """What the step moves."""
    end_rad = OF_TRAVEL * site.rig.loops[site.name].siderostat.travel_rad
    return (
        f"each motor to {end_rad:.1f} rad both ways, {OF_TRAVEL:.0%} of its travel, at "
        f"{within_limit(site, FAST_RAD_S):g} rad/s and over the last part of the way at "
        f"{within_limit(site, SLOW_RAD_S):g} rad/s; stopped as soon as it lags; then back"
    )


def check_travel(site: Site) -> Outcome:
    """Turn each motor to both ends of the rig file's travel and back to where it was.

    Raises
    ------
    StepError
        If a motor stops on the way.
    """
    siderostat = site.rig.loops[site.name].siderostat
    end_rad = OF_TRAVEL * siderostat.travel_rad
    figures: dict[str, float] = {}
    with powered(site) as motors:
        motors.exchange((0.0, 0.0))
        start_rad = motors.position_rad
        for axis in range(2):
            for way in (1.0, -1.0):
                site.report(f"{axis_name(axis)}: to {way * end_rad:+.1f} rad")
                reached_rad = _turn(site, motors, axis, way * end_rad)
                figures[f"{axis_name(axis)}_reached_{'high' if way > 0 else 'low'}_rad"] = (
                    reached_rad
                )
                if abs(reached_rad - way * end_rad) > _THERE_RAD:
                    _turn(site, motors, axis, start_rad[axis])
                    raise StepError(_stopped(site, axis, reached_rad, way * end_rad), figures)
            _turn(site, motors, axis, start_rad[axis])
        figures["furthest_rad"] = motors.furthest_rad
    lines = [f"both motors turn to {end_rad:.1f} rad both ways and back"]
    return Outcome(lines, figures)


def _stopped(site: Site, axis: int, reached_rad: float, goal_rad: float) -> str:
    siderostat = site.rig.loops[site.name].siderostat
    fits_arcsec = siderostat.travel_sky_arcsec * abs(reached_rad) / siderostat.travel_rad
    return (
        f"{axis_name(axis)} stopped at {reached_rad:+.1f} rad on its way to {goal_rad:+.1f} rad. Look for a "
        "mechanical end, an end switch, or a position limit of the amplifier that is tighter than "
        f"travel_sky_arcsec. Move that limit, or set loops.{site.name}.siderostat.travel_sky_arcsec to less "
        f"than {fits_arcsec:.0f}; if the motor turns nowhere any more, check its coupling and its brake"
    )


def _turn(site: Site, motors: Motors, axis: int, goal_rad: float) -> float:
    """Turn one motor towards an angle; where it is in the end, there or stopped on the way.

    Raises
    ------
    StepError
        If the other motor moves, or an amplifier reports a fault.
    """
    began_rad = motors.position_rad
    slow_beyond_rad = _SLOW_FROM * OF_TRAVEL * site.rig.loops[site.name].siderostat.travel_rad
    look_s = last_s = site.clock.now_s()
    looked_rad, wanted_rad = began_rad[axis], 0.0
    while abs(apart_rad := goal_rad - motors.position_rad[axis]) > _THERE_RAD:
        near_end = min(abs(goal_rad), motors.position_rad[axis] * math.copysign(1.0, goal_rad))
        most_rad_s = within_limit(site, SLOW_RAD_S if near_end > slow_beyond_rad else FAST_RAD_S)
        velocity = max(-most_rad_s, min(most_rad_s, _GAIN_PER_S * apart_rad))
        try:
            motors.exchange((velocity, 0.0) if axis == 0 else (0.0, velocity))
        except StepError as error:
            at_rad = motors.position_rad[axis]
            msg = f"{axis_name(axis)} at {at_rad:+.1f} rad, on its way to {goal_rad:+.1f}: {error}"
            raise StepError(msg) from None
        now_s = site.clock.now_s()
        wanted_rad, last_s = wanted_rad + abs(velocity) * (now_s - last_s), now_s
        other = 1 - axis
        if abs(motors.position_rad[other] - began_rad[other]) > _OTHER_RAD:
            msg = (
                f"{axis_name(other)} moved while {axis_name(axis)} was commanded; check the cables"
            )
            raise StepError(msg, {"furthest_rad": motors.furthest_rad})
        if abs(goal_rad - motors.position_rad[axis]) > abs(goal_rad - began_rad[axis]) + _OTHER_RAD:
            msg = f"{axis_name(axis)} turns away from its set-point; repeat the step amplifiers"
            raise StepError(msg, {"furthest_rad": motors.furthest_rad})
        if now_s - look_s > _LOOK_S:
            if abs(motors.position_rad[axis] - looked_rad) < _PART * wanted_rad:
                break
            look_s, looked_rad, wanted_rad = now_s, motors.position_rad[axis], 0.0
    motors.exchange((0.0, 0.0))
    return motors.position_rad[axis]
