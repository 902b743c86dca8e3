"""The coarse loop: its integrator against the backlash, by describing function; and the prefilter before it.

The siderostat's play is behind its encoders, so no servo sees it: the star loop alone can swing with it.
A sine of amplitude A passes a play of half width h with the gain and the lag of N(A); the loop swings
by itself where N(A) L(jw) = -1.

On FIT, beside the paper: an integrator behind 50 ms of lag swings with its play from 4.8 Hz on, where it
would swing from 5.0 Hz on without any play; beside Eq. 20 at work, from 2.3 Hz on. The paper's empirical
tenth of a hertz does not follow from its own Fig. 8, nor does its describing function show it: its play
alone never adds more than the 90 degrees that an integrator leaves. What does follow is that the margin
vanishes at any gain for swings just above the half width, so that such swings, 0.2 px on FIT, die slowly;
what the model leaves out, such as stiction, may keep them alive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.loopshape import Response
from fitctl.model.backlash import describing_function

Floats = NDArray[np.float64]

SERVO_BANDWIDTH_HZ = 45.0  # of the siderostat's position servo, second order
_SERVO_DAMPING = 0.7
_SETTLES = 5.8339  # (1 + x) exp(-x) = 0.02
_AMPLITUDES: Floats = 1 + np.geomspace(0.01, 99.0, 400)  # in half widths


class LimitCycle(NamedTuple):
    """A swing that feeds itself.

    Attributes
    ----------
    gain_hz : float
        Coarse gain, as the crossover of the integrator alone, at which it can be.
    frequency_hz : float
    amplitude_half_widths : float
        Of the motor's swing, in half widths of the play.
    """

    gain_hz: float
    frequency_hz: float
    amplitude_half_widths: float


def siderostat_response(basis: Basis) -> Response:
    """An integrator of 1 rad/s as the star loop meets it: delay, walk over one period, position servo."""
    return integrator_response(basis.delay_s, basis.period_s)


def integrator_response(delay_s: float, period_s: float) -> Response:
    """An integrator of 1 rad/s of a siderostat's set-point, `delay_s` after what it acts on was measured."""
    wn = 2 * math.pi * SERVO_BANDWIDTH_HZ

    def response(omega_rad_s: Floats) -> NDArray[np.complex128]:
        s = 1j * np.asarray(omega_rad_s)
        servo = wn**2 / (s**2 + 2 * _SERVO_DAMPING * wn * s + wn**2)
        # Each set-point is reached in a straight line, one period after it was given.
        lag_s = delay_s + period_s / 2
        return np.asarray(np.exp(-s * lag_s) * servo / s)

    return response


def limit_cycles(basis: Basis, vernier: Response | None = None) -> list[LimitCycle]:
    """Where the coarse loop swings by itself: one for each amplitude, from small to large.

    Parameters
    ----------
    vernier : callable, optional
        Response of the vernier compensator at work beside it (Eq. 16 without the delay); by default
        the siderostat is alone, as in COARSE.
    """
    omega = 2 * math.pi * np.geomspace(0.01, 0.5 / basis.period_s, 8000)
    loop = siderostat_response(basis)(omega)
    if vernier is not None:
        # What the vernier leaves of a motion of the siderostat.
        loop = loop / (1 + vernier(omega) * np.exp(-1j * omega * basis.delay_s))
    return cycles_of(loop, omega)


def cycles_of(loop: NDArray[np.complex128], omega_rad_s: Floats) -> list[LimitCycle]:
    """Where a loop of unit gain would swing by itself with a play in it, as :func:`limit_cycles`."""
    phase = np.unwrap(np.angle(loop))
    cycles = []
    for amplitude, play in zip(_AMPLITUDES, describing_function(_AMPLITUDES, 1.0), strict=True):
        crossing = np.flatnonzero(np.diff(np.sign(phase + np.angle(play) + math.pi)) < 0)
        gains = [1 / abs(play * loop[i]) for i in crossing]
        if gains:
            first = int(np.argmin(gains))
            cycles.append(
                LimitCycle(
                    gain_hz=float(gains[first]) / (2 * math.pi),
                    frequency_hz=float(omega_rad_s[crossing[first]]) / (2 * math.pi),
                    amplitude_half_widths=float(amplitude),
                )
            )
    return cycles


def onset(cycles: list[LimitCycle]) -> LimitCycle:
    """The limit cycle of the lowest gain: below it the play cannot keep the loop swinging."""
    return min(cycles, key=lambda cycle: cycle.gain_hz)


def phase_margin_deg(basis: Basis, gain_hz: float, amplitude_half_widths: float) -> float:
    """Phase margin of the coarse loop alone for a swing of one amplitude."""
    play = complex(describing_function(amplitude_half_widths, 1.0))
    omega = 2 * math.pi * np.geomspace(1e-4, 0.5 / basis.period_s, 8000)
    loop = 2 * math.pi * gain_hz * play * siderostat_response(basis)(omega)
    crossing = int(np.abs(np.log(np.abs(loop))).argmin())
    return float(np.degrees(np.unwrap(np.angle(loop))[crossing])) + 180.0


class PrefilterDesign(NamedTuple):
    """What the prefilter makes of a step.

    Attributes
    ----------
    bandwidth_hz : float
        At which it passes half the power.
    fastest_per_s : float
        Fastest motion of its output, of a unit step.
    settling_s : float
        Until a step is within 2 % of its end.
    largest_step_px : float
        Largest step that leaves the mirror within its range, the siderostat standing still.
    """

    bandwidth_hz: float
    fastest_per_s: float
    settling_s: float
    largest_step_px: float


def prefilter_design(basis: Basis, time_constant_s: float) -> PrefilterDesign:
    """The critically damped second-order filter 1 / (T s + 1)^2."""
    return PrefilterDesign(
        bandwidth_hz=math.sqrt(math.sqrt(2) - 1) / (2 * math.pi * time_constant_s),
        fastest_per_s=1 / (math.e * time_constant_s),
        settling_s=_SETTLES * time_constant_s,
        largest_step_px=basis.mirror_range_px,
    )
