"""Acceptance: acquisitions, a long hold, steps of the target, STOP from every mode, and cables taken off."""

from __future__ import annotations

import math
import time

import numpy as np

from fitctl.commissioning.outcome import Cable, Outcome, Site, StepError
from fitctl.commissioning.steps.closed import (
    SETTLED_S,
    STOPPED_S,
    Loop,
    judged,
    supervised,
    with_link,
)
from fitctl.identify import airpath
from fitctl.messages.commands import Acquire, Experiment, Jog, Recover, SetTarget, Stop
from fitctl.messages.modes import Mode

TIMES, QUICK_TIMES = 10, 3
HOLD_S, QUICK_HOLD_S = 300.0, 20.0
STEP_PX = 1.0
JOG_ARCSEC = 30.0
_STEP_SETTLES = 7.0  # time constants of the prefilter
_STEP_HOLD_S = 4.0
_STEPS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
_NO_STAR = 20.0  # times star_flux_dn, which no star has: the search goes on
SAFE_WITHIN_S = 10.0
_PLUGGED_S = 60.0  # until a device that was away answers again
_PAUSE_S = 2.0


def accept_moves(site: Site) -> str:
    """What the step moves."""
    times, hold_s = _amount(site)
    return with_link(
        site,
        f"siderostat and mirror, as in operation: {times} acquisitions, {hold_s:g} s on the star, "
        f"steps of {STEP_PX:g} px, and STOP from each mode",
    )


def check_acceptance(site: Site) -> Outcome:
    """Acquire again and again with STOP between, hold for long, step the target, and stop from each mode.

    Raises
    ------
    StepError
        If one acquisition fails, a STOP is late, the star is lost, or a step is not followed.
    """
    times, hold_s = _amount(site)
    took_s, stops_s = [], []
    with supervised(site) as loop:
        for number in range(times):
            site.report(f"acquisition {number + 1} of {times}")
            angle = 2 * math.pi * number / times
            away = Jog(
                loop=site.name,
                az_sky_arcsec=JOG_ARCSEC * math.cos(angle),
                el_sky_arcsec=JOG_ARCSEC * math.sin(angle),
            )
            loop.command(away)
            time.sleep(_PAUSE_S)
            took_s.append(loop.acquire())
            if number + 1 < times:
                stops_s.append(loop.stop())
                loop.command(Recover())
        time.sleep(SETTLED_S)
        site.report(f"holds for {hold_s:g} s")
        figures = loop.hold(hold_s)
        figures |= _follow_steps(site, loop)
        stops_s.append(loop.stop())
        stops = {mode: _stop_from(site, loop, mode) for mode in _WAYS}
    figures |= {
        "acquisitions": float(times),
        "slowest_acquisition_s": max(took_s),
        "slowest_stop_s": max(*stops_s, *stops.values()),
        "held_s": hold_s,
    }
    figures |= {f"stop_from_{mode.name.lower()}_s": took for mode, took in stops.items()}
    if figures["slowest_stop_s"] > STOPPED_S:
        slowest = figures["slowest_stop_s"]
        msg = f"a STOP took {slowest:.2f} s to SAFE, expected less than {STOPPED_S:g} s"
        raise StepError(msg, figures)
    outcome = judged(site, figures, f"acquired {times} times, held for {hold_s:g} s")
    outcome.lines.append(
        f"steps of {STEP_PX:g} px followed to {figures['step_error_px']:.3f} px; STOP from "
        f"{', '.join(mode.name for mode in stops)} within {figures['slowest_stop_s']:.2f} s"
    )
    return outcome


def _amount(site: Site) -> tuple[int, float]:
    return (QUICK_TIMES, QUICK_HOLD_S) if site.quick else (TIMES, HOLD_S)


def _follow_steps(site: Site, loop: Loop) -> dict[str, float]:
    """Step the target to each side and back; how far the star's mean stayed from it, at most."""
    at = site.loop.target_px
    ways = _STEPS[:1] if site.quick else _STEPS
    settle_s = _STEP_SETTLES * site.loop.prefilter.time_constant_s
    worst_px = 0.0
    for az, el in (*ways, (0.0, 0.0)):
        goal = np.array([at.az + STEP_PX * az, at.el + STEP_PX * el])
        site.report(f"target az {goal[0]:.1f}, el {goal[1]:.1f} px")
        loop.command(SetTarget(loop=site.name, az_px=float(goal[0]), el_px=float(goal[1])))
        time.sleep(settle_s)
        place_px = loop.mean_px(_STEP_HOLD_S)
        worst_px = max(worst_px, float(np.max(np.abs(place_px - goal))))
    figures = {"step_error_px": worst_px}
    if worst_px > site.loop.requirement_px:
        msg = (
            f"after a step of the target by {STEP_PX:g} px, the star stayed {worst_px:.3f} px from it; "
            f"the requirement is {site.loop.requirement_px:g} px; check the siderostat's backlash and "
            "the design"
        )
        raise StepError(msg, figures)
    return figures


# ---------------------------------------------------------------- STOP from every mode
def _search(site: Site, loop: Loop) -> None:
    loop.command(Acquire(loop=site.name, star_flux_dn=_NO_STAR * site.loop.star_flux_dn))


def _acquire(site: Site, loop: Loop) -> None:
    loop.command(Acquire(loop=site.name, star_flux_dn=site.loop.star_flux_dn))


def _experiment(site: Site, loop: Loop) -> None:
    _acquire(site, loop)
    loop.until(Mode.VERNIER)
    still = airpath.plan(site.rig, site.name)  # its motion has no amplitude
    loop.command(Experiment(loop=site.name, name="airpath", drives=still))


_WAYS = {
    Mode.STANDBY: lambda _site, _loop: None,
    Mode.ACQUISITION: _search,
    Mode.COARSE: _acquire,
    Mode.VERNIER: _acquire,
    Mode.EXPERIMENT: _experiment,
}
"""What leads from STANDBY to each mode."""


def _stop_from(site: Site, loop: Loop, mode: Mode) -> float:
    """Recover, go to a mode, STOP; how long until SAFE."""
    site.report(f"STOP from {mode.name}")
    loop.command(Recover())
    _WAYS[mode](site, loop)
    loop.until(mode)
    return loop.stop()


# ---------------------------------------------------------------- cables
def cables_moves(site: Site) -> str:
    """What the step moves."""
    named = ", ".join(cable.name for cable in cables_of(site))
    return (
        "siderostat and mirror, as in operation. While the loop holds the star, you disconnect these, one "
        f"after the other: {named}"
    )


def cables_of(site: Site) -> list[Cable]:
    """Those of a stellar loop."""
    return [
        Cable("the camera's network cable", "camera"),
        Cable("the link to the siderostat's amplifiers", f"{site.name}.drive"),
        Cable("the link to the D/A", f"{site.name}.dac"),
        Cable("the link to the piezo amplifier", f"{site.name}.mdt693"),
    ]


def check_cables(site: Site) -> Outcome:
    """With the star held, a person takes one cable off after the other; each must lead to SAFE.

    Raises
    ------
    StepError
        If one does not, or the loop does not recover. A cable that is off is put on again first.
    """
    lines: list[str] = []
    figures: dict[str, float] = {}
    off: Cable | None = None
    try:
        with supervised(site) as loop:
            for cable in cables_of(site):
                loop.acquire()
                time.sleep(SETTLED_S)
                off = cable
                site.cable(cable, False)
                took_s = loop.wait_for(Mode.SAFE, SAFE_WITHIN_S)
                loop.client.send(Stop())
                site.cable(cable, True)
                off = None
                if math.isnan(took_s):
                    msg = (
                        f"{cable.name} was off for {SAFE_WITHIN_S:g} s and the loop did not go to SAFE; do not "
                        "operate the instrument, and see docs/interlocks.md"
                    )
                    raise StepError(msg, figures)
                figures[f"{cable.mock.rpartition('.')[2]}_safe_s"] = took_s
                lines.append(f"{cable.name}: SAFE {took_s:.2f} s after it was off")
                _recover(cable, loop)
    finally:  # by now the supervisor has ended
        if off is not None:
            site.cable(off, True)
    return Outcome(lines, figures)


def _recover(cable: Cable, loop: Loop) -> None:
    """STANDBY again, as soon as the device answers."""
    until_s = time.monotonic() + _PLUGGED_S
    while True:
        time.sleep(_PAUSE_S)
        try:
            loop.command(Recover())
        except StepError as error:
            if time.monotonic() > until_s:
                msg = f"{cable.name} is connected again, but the loop does not recover: {error}"
                raise StepError(msg) from None
        else:
            return
