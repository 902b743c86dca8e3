"""How far a design is from instability, and a minimum-variance pair that keeps away from it.

The least residual by itself promises nothing about stability: Doyle, IEEE Trans. Automatic Control 23, 756
(1978), shows that optimal estimators leave no guaranteed margins. A good sensor and narrow lines ask for more
gain than a loop with a delay of two frames can bear, so the search here gives up some residual for margins.

To limit the sensitivity S at a frequency, the design expects motion there that does not exist, the guard:
of a minimum under the constraint |S| <= 2, Lagrange's multipliers are such motion. More noise than there is
would limit S as well, at all frequencies alike, which costs more: with the fit as sensor 23 % of the residual
instead of 11 %.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from fitctl.config import ConfigError
from fitctl.controllers.design.basis import Basis, Line
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
_LOWEST_HZ = 0.01
_POINTS = 400
_ABOUT_LINE = 24  # points on each side of a line, which lie closer towards it
_GAINS = 5  # looked at, from the least to the greatest
_PENALTY = 10.0  # of a residual, for missing a margin by its whole size
_TRIES = 250
_REMEMBERED = 16  # frequencies of a basis, for the hundreds of designs of one search
KEPT = 1.001
"""A search ends at a margin only within rounding."""
# Where the search for a guard begins: noise and the guard's RMS in the sensor's noise, and its damping.
_NOISE, _GUARD, _DAMPING = 1.02, 2.0, 0.5
_WIDEST, _NARROWEST = 0.95, 0.02  # damping of a guard
# Where the second search begins, and how far it goes: noise, guard's frequency in Hz, damping and RMS. A value
# that misses by more than the farthest counts as that: a loop that is unstable has infinite ones.
_STRONG_NOISE, _STRONG_GUARD = 1.5, 20.0
_BOUNDS = ((1.0, 20.0), (0.5, math.inf), (_NARROWEST, _WIDEST), (0.05, 1e5))
_FARTHEST = 3.0
_NEAR = 1.05  # of the residual without margins: what leaves no more needs no second search


class Required(NamedTuple):
    """The margins that a design must have.

    Attributes
    ----------
    peak_sensitivity : float
        The largest amplification of a disturbance.
    gain_margin_db, phase_margin_deg : float
    least_gain, greatest_gain : float
        Between these factors in the gain of the stages the loop is stable,
    delay_s : float
        also with so much more or less delay; at most a quarter of a frame.
    """

    peak_sensitivity: float = 2.0
    gain_margin_db: float = 6.0
    phase_margin_deg: float = 35.0
    least_gain: float = 0.7
    greatest_gain: float = 1.4
    delay_s: float = 0.005


class Margins(NamedTuple):
    """The margins that a design has.

    Attributes
    ----------
    stable : bool
        For all gains and delays of what is required.
    peak_sensitivity : float
        Infinite for a loop that is unstable as it is.
    gain_margin_db, phase_margin_deg : float
        The smallest; infinite where the loop has none.
    """

    stable: bool
    peak_sensitivity: float
    gain_margin_db: float
    phase_margin_deg: float

    def excess(self, required: Required) -> float:
        """By what factor the worst of them misses what is required; at most 1 where all are kept."""
        return max(self.ratios(required))

    def ratios(self, required: Required) -> tuple[float, float, float, float]:
        """By what factor each of them misses what is required, stability last."""
        return (
            self.peak_sensitivity / required.peak_sensitivity,
            required.gain_margin_db / max(self.gain_margin_db, 1e-3),
            required.phase_margin_deg / max(self.phase_margin_deg, 1e-3),
            1.0 if self.stable else 2.0,
        )


def margins(design: Design, basis: Basis, required: Required | None = None) -> Margins:
    """Of a design in its loop: opened at the camera, sampled, with hold and delay.

    Parameters
    ----------
    basis : Basis
        Its lines say where the response is looked at closely.
    required : Required, optional
        Which gains and delays the loop must be stable for.
    """
    asked = required or Required()
    stable = _stable(design, basis, asked)
    if not sampled_loop(design, basis).stable:
        return Margins(False, math.inf, 0.0, 0.0)
    loop = sampled_response(design, basis)(2 * math.pi * frequencies_hz(basis))
    gain = np.abs(loop)
    # Where the gain passes through one, and where the loop crosses the real axis between -1 and 0.
    crossing = np.flatnonzero(np.diff(np.sign(gain - 1)))
    part = (1 - gain[crossing]) / (gain[crossing + 1] - gain[crossing])
    at_one = loop[crossing] + part * (loop[crossing + 1] - loop[crossing])
    phases_deg = np.degrees(np.abs(np.angle(-at_one)))
    turning = np.flatnonzero(np.diff(np.sign(loop.imag)))
    part = loop.imag[turning] / (loop.imag[turning] - loop.imag[turning + 1])
    real = loop.real[turning] + part * (loop.real[turning + 1] - loop.real[turning])
    # At half the frame rate the response is real.
    real = np.append(real, loop.real[-1])
    below_one = -real[(real < 0) & (real > -1)]
    return Margins(
        stable=stable,
        peak_sensitivity=float((1 / np.abs(1 + loop)).max()),
        gain_margin_db=float(-20 * np.log10(below_one.max())) if len(below_one) else math.inf,
        phase_margin_deg=float(phases_deg.min()) if len(phases_deg) else math.inf,
    )


def frequencies_hz(basis: Basis) -> Floats:
    """From slow to half the frame rate, ascending, and closer together about each line."""
    return _frequencies_hz(0.5 / basis.period_s, basis.lines)


@functools.lru_cache(_REMEMBERED)
def _frequencies_hz(highest_hz: float, lines: tuple[Line, ...]) -> Floats:
    found = [np.geomspace(_LOWEST_HZ, highest_hz, _POINTS)]
    for line in lines:
        away = line.frequency_hz * np.geomspace(line.damping / 10, 0.3, _ABOUT_LINE)
        found += [line.frequency_hz - away, line.frequency_hz + np.append(0.0, away)]
    every = np.unique(np.concatenate(found))
    return np.asarray(every[every <= highest_hz])


def _stable(design: Design, basis: Basis, required: Required) -> bool:
    more_s = min(required.delay_s, basis.period_s / 4)
    gains = np.linspace(required.least_gain, required.greatest_gain, _GAINS)
    for delay_s in (max(0.0, basis.delay_s - more_s), basis.delay_s, basis.delay_s + more_s):
        loop = sampled_loop(design, dataclasses.replace(basis, delay_s=delay_s))
        closed = loop.a + gains[:, None, None] * np.outer(loop.b, loop.star)
        if np.abs(np.linalg.eigvals(closed)).max() >= 1.0:
            return False
    return True


class _Guards(NamedTuple):
    """Designs with a guard, by the logarithms of noise, and of the guard's frequency, damping and RMS.

    Their residuals count in the least one; a search may begin near those of another design.
    """

    basis: Basis
    required: Required
    least_px: float
    near: Floats | None

    def design(self, logs: Floats) -> Design:
        noise, guard_hz, damping, rms = np.exp(logs).tolist()
        basis = self.basis
        guard = Line(
            frequency_hz=min(guard_hz, 0.5 / basis.period_s),
            damping=min(max(damping, _NARROWEST), _WIDEST),
            rms_px=rms * basis.noise_px,
        )
        guarded = dataclasses.replace(basis, noise_px=max(noise, 1.0) * basis.noise_px, guard=guard)
        return design_minimum_variance(guarded)

    def residual_and_ratios(self, logs: Floats) -> tuple[float, Floats]:
        """In the least residual, and by what factor each margin is missed."""
        try:
            design = self.design(logs)
        except (ValueError, ArithmeticError):  # no solution so far out
            return math.inf, np.full(4, math.inf)
        ratios = margins(design, self.basis, self.required).ratios(self.required)
        return linear_residual(design, self.basis) / self.least_px, np.array(ratios)


def _by_simplex(guards: _Guards, worst_hz: float) -> Floats:
    """What comes nearest to the least residual on most nights."""

    def cost(logs: Floats) -> float:
        residual, ratios = guards.residual_and_ratios(logs)
        return float(residual + _PENALTY * max(0.0, ratios.max() - 1.0))

    begin, size = np.log([_NOISE, worst_hz, _DAMPING, _GUARD]), 0.4
    if guards.near is not None:
        begin, size = guards.near, 0.1
    corners = np.vstack([begin, begin + size * np.eye(len(begin))])
    options = {"maxfev": _TRIES, "initial_simplex": corners, "fatol": 1e-4, "xatol": 1e-2}
    return np.asarray(minimize(cost, begin, method="Nelder-Mead", options=options).x)


def _from_a_strong_guard(guards: _Guards, worst_hz: float) -> Floats:
    """From the other side, by a model of residual and margins: some nights have their designs only there."""
    low, high = np.log(_BOUNDS).T
    high[1] = math.log(0.5 / guards.basis.period_s)
    begin = np.clip(np.log([_STRONG_NOISE, worst_hz, _DAMPING, _STRONG_GUARD]), low, high)
    # The search asks for residual and margins of each place, and for some places again.
    known: dict[bytes, tuple[float, Floats]] = {}

    def tried(logs: Floats) -> tuple[float, Floats]:
        place = logs.tobytes()
        if place not in known:
            known[place] = guards.residual_and_ratios(logs)
        return known[place]

    return np.asarray(
        minimize(
            lambda logs: min(tried(logs)[0], _FARTHEST),
            begin,
            method="COBYQA",
            bounds=list(zip(low, high, strict=True)),
            constraints={
                "type": "ineq",
                "fun": lambda logs: 1.0 - np.minimum(tried(logs)[1], _FARTHEST),
            },
            options={"maxfev": _TRIES, "initial_tr_radius": 0.4, "final_tr_radius": 5e-3},
        ).x
    )


def _near(basis: Basis, design: Design | None) -> Floats | None:
    """Where the search for a design like another begins; None if that has no guard, or is for other lines."""
    made_from = {} if design is None else design.parameters
    if "guard" not in made_from or len(made_from.get("lines", ())) != len(basis.lines):
        return None
    noise_px, guard = made_from["noise_px"], made_from["guard"]
    found = (
        max(1.0, noise_px / basis.noise_px),
        guard["frequency_hz"],
        guard["damping"],
        guard["rms_px"] / basis.noise_px,
    )
    return np.log(found)


def design_with_margins(
    basis: Basis, required: Required | None = None, like: Design | None = None
) -> Design:
    """The minimum-variance pair of a basis if it has the margins; otherwise the one nearest to it that has.

    Parameters
    ----------
    basis : Basis
    required : Required, optional
    like : Design, optional
        For nearly the same basis, and the best that was found there: the search begins at its guard.

    Raises
    ------
    ConfigError
        If none was found.
    """
    asked = required or Required()
    design = design_minimum_variance(basis)
    if margins(design, basis, asked).excess(asked) <= 1.0:
        return design
    frequency_hz = frequencies_hz(basis)
    response = sampled_response(design, basis)(2 * math.pi * frequency_hz)
    worst_hz = float(frequency_hz[np.argmin(np.abs(1 + response))])
    guards = _Guards(basis, asked, linear_residual(design, basis), _near(basis, like))
    found: list[tuple[float, Design]] = []
    nearest = margins(design, basis, asked)
    for search in (_by_simplex, _from_a_strong_guard):
        try:
            design = guards.design(search(guards, worst_hz))
        except (ValueError, ArithmeticError):  # the search ended where there is no solution
            continue
        kept = margins(design, basis, asked)
        nearest = min(nearest, kept, key=lambda one: one.excess(asked))
        if kept.excess(asked) <= KEPT:
            found.append((linear_residual(design, basis), design))
            if guards.near is not None or found[-1][0] <= _NEAR * guards.least_px:
                break
    if found:
        return min(found, key=lambda each: each[0])[1]
    msg = (
        f"design: no minimum-variance pair with sensitivity at most {asked.peak_sensitivity:g}, gain "
        f"margin {asked.gain_margin_db:g} dB and phase margin {asked.phase_margin_deg:g} deg was found at "
        f"{basis.delay_s * 1e3:g} ms of delay; the best has {nearest.peak_sensitivity:.2f}, "
        f"{nearest.gain_margin_db:.1f} dB and {nearest.phase_margin_deg:.0f} deg; measure the delay with "
        "fitctl identify delay, or choose another design"
    )
    raise ConfigError(msg)
