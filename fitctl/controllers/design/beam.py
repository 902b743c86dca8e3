"""The metrology loop's two integrators against its siderostat's backlash, by describing function.

As in the coarse loop, the play is behind the encoders. The first integrator alone swings with it only beyond a
crossover that delay and servo set. The second makes a slow swing possible at any crossover: it leaves the
play no phase at low frequencies; that swing of the motors hardly passes the play, so that the beam's is small.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.coarse import LimitCycle, cycles_of, integrator_response, onset
from fitctl.model.backlash import describing_function

Floats = NDArray[np.float64]
_OMEGA_RAD_S: Floats = 2 * math.pi * np.geomspace(1e-3, 25.0, 40_000)
_AMPLITUDES: Floats = 1 + np.geomspace(1e-3, 99.0, 2000)  # in half widths


class SlowSwing(NamedTuple):
    """The slow swing that the second integrator makes possible.

    Attributes
    ----------
    frequency_hz : float
    beam_half_widths : float
        Amplitude of the beam, in half widths of the play.
    """

    frequency_hz: float
    beam_half_widths: float


def beam_loop(
    second_integrator_hz: float, delay_s: float, period_s: float, omega_rad_s: Floats
) -> NDArray[np.complex128]:
    """Both integrators for a crossover of 1 rad/s, with delay, servo and the walk between set-points."""
    second = 1 + 2 * math.pi * second_integrator_hz / (1j * omega_rad_s)
    return np.asarray(second * integrator_response(delay_s, period_s)(omega_rad_s))


def fast_onset(delay_s: float, period_s: float) -> LimitCycle:
    """The lowest crossover at which the first integrator and the play keep each other swinging."""
    omega = _OMEGA_RAD_S[math.pi / period_s > _OMEGA_RAD_S]
    return onset(cycles_of(beam_loop(0.0, delay_s, period_s, omega), omega))


def margins(
    crossover_hz: float, second_integrator_hz: float, delay_s: float, period_s: float
) -> tuple[float, float]:
    """Phase margin in degrees, and the peak of the sensitivity, of a beam that swings far beyond the play."""
    omega = _OMEGA_RAD_S[math.pi / period_s > _OMEGA_RAD_S]
    loop = 2 * math.pi * crossover_hz * beam_loop(second_integrator_hz, delay_s, period_s, omega)
    crossing = int(np.abs(np.log(np.abs(loop))).argmin())
    margin_deg = float(np.degrees(np.unwrap(np.angle(loop))[crossing])) + 180.0
    return margin_deg, float(np.max(1 / np.abs(1 + loop)))


def slow_swing(
    crossover_hz: float, second_integrator_hz: float, delay_s: float, period_s: float
) -> SlowSwing | None:
    """The slow swing of a loop at rest; None without a second integrator.

    The lowest frequency at which the describing function N of a play has N L = -1.
    """
    if not second_integrator_hz:
        return None
    omega = _OMEGA_RAD_S[2 * math.pi * crossover_hz > _OMEGA_RAD_S]
    loop = 2 * math.pi * crossover_hz * beam_loop(second_integrator_hz, delay_s, period_s, omega)
    found = []
    for amplitude, play in zip(
        _AMPLITUDES.tolist(), describing_function(_AMPLITUDES, 1.0), strict=True
    ):
        phase = np.unwrap(np.angle(loop)) + np.angle(play) + math.pi
        crossing = np.flatnonzero(np.diff(np.sign(phase)) > 0)
        if len(crossing):
            first = int(crossing[0])
            found.append((abs(play * loop[first]), omega[first], amplitude, abs(play)))
    gains = np.log([gain for gain, *_ in found])
    turns = np.flatnonzero(np.diff(np.sign(gains)))
    if not len(turns):
        return None
    _, omega_rad_s, amplitude, gain = found[int(turns[0])]
    return SlowSwing(float(omega_rad_s) / (2 * math.pi), amplitude * float(gain))
