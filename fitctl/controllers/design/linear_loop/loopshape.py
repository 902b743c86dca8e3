"""Loop shapes: crossover, margins and attenuation, of the paper's continuous loop and of a sampled design."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Response = Callable[[Floats], Complexes]

ATTENUATION_HZ = (0.1, 0.5, 1.0, 2.0)
LOWEST_HZ = 1e-3
_POINTS = 6000


class LoopShape(NamedTuple):
    """Margins and attenuation of a loop.

    Attributes
    ----------
    stable : bool
        Once closed. Where it is not, nothing but the crossover means anything, and the rest is nan.
    crossover_hz : float
        Highest frequency at which the loop's gain falls through one; nan where it does not.
    phase_margin_deg, gain_margin_db : float
        The smallest; infinite where the loop has none.
    peak_sensitivity : float
        Largest amplification of a disturbance.
    peak_sensitivity_hz : float
    attenuation : dict of float to float
        Of a disturbance, at each of `ATTENUATION_HZ` below the loop's highest frequency.
    """

    stable: bool
    crossover_hz: float
    phase_margin_deg: float
    gain_margin_db: float
    peak_sensitivity: float
    peak_sensitivity_hz: float
    attenuation: dict[float, float]


def compensator_response(zeros: Complexes, poles: Complexes, gain: float) -> Response:
    """Frequency response, over rad/s, of a continuous compensator."""

    def response(omega_rad_s: Floats) -> Complexes:
        s = 1j * np.asarray(omega_rad_s)[..., None]
        ratio = np.prod(s - zeros, axis=-1) / np.prod(s - poles, axis=-1)
        return np.asarray(gain * ratio, dtype=complex)

    return response


def coarse_response(basis: Basis) -> Response:
    """The siderostat's integrator."""
    return compensator_response(np.empty(0, complex), np.zeros(1, complex), basis.coarse_per_s)


def delayed(basis: Basis, *stages: Response) -> Response:
    """Eq. 16: stages in parallel behind the frame delay, exp(-s T_fd) exactly."""
    return lambda omega_rad_s: np.asarray(
        sum(stage(omega_rad_s) for stage in stages)
        * np.exp(-1j * np.asarray(omega_rad_s) * basis.delay_s)
    )


def sampled_response(design: Design, basis: Basis) -> Response:
    """A design from camera to camera, with hold and delay, over rad/s up to half the frame rate.

    With its measurements of the stages connected, as they are when it works, and opened at the star's
    error alone: its sign is that of Eq. 16.
    """
    from scipy.linalg import schur  # a supervisor imports no scipy

    loop = sampled_loop(design, basis)
    # Triangular, so that all frequencies are solved together, state by state: several times as quick.
    triangle, turn = schur(loop.a, output="complex")
    drive, star = turn.conj().T @ loop.b, loop.star @ turn

    def response(omega_rad_s: Floats) -> Complexes:
        z = np.exp(1j * np.asarray(omega_rad_s) * basis.period_s)
        states = np.zeros((len(drive), *z.shape), dtype=complex)
        for n in reversed(range(len(drive))):
            others = triangle[n, n + 1 :] @ states[n + 1 :]
            states[n] = (drive[n] + others) / (z - triangle[n, n])
        return np.asarray(-np.tensordot(star, states, axes=1))

    return response


def loop_shape(response: Response, highest_hz: float, *, stable: bool | None = None) -> LoopShape:
    """Crossover, margins and attenuation of a loop, from `LOWEST_HZ` to `highest_hz`.

    Parameters
    ----------
    response : callable
        Of the open loop.
    highest_hz : float
        Beyond, the loop's gain must be below one.
    stable : bool, optional
        Whether the closed loop is; by default by Nyquist's criterion, for a loop that is stable when
        open but for one integrator, as Eq. 16 is.
    """
    import control  # a second of import, and only designs need it

    omega = 2 * math.pi * np.geomspace(LOWEST_HZ, highest_hz, _POINTS)
    loop = response(omega)
    gain_margins, phase_margins, *_, crossings, _ = control.stability_margins(
        control.FRD(loop, omega, smooth=True), returnall=True
    )
    crossover_hz = float(max(crossings, default=math.nan)) / (2 * math.pi)
    compared_hz = [hz for hz in ATTENUATION_HZ if hz < highest_hz]
    if stable is None:
        # From an integrator's side to near 1, around the origin not once.
        stable = bool(abs(np.unwrap(np.angle(1 + loop))[-1]) < math.pi)
    if not stable:
        return LoopShape(
            stable=False,
            crossover_hz=crossover_hz,
            phase_margin_deg=math.nan,
            gain_margin_db=math.nan,
            peak_sensitivity=math.nan,
            peak_sensitivity_hz=math.nan,
            attenuation=dict.fromkeys(compared_hz, math.nan),
        )
    sensitivity = 1 / np.abs(1 + loop)
    peak = int(sensitivity.argmax())
    above_one = [margin for margin in gain_margins if margin > 1]
    return LoopShape(
        stable=True,
        crossover_hz=crossover_hz,
        phase_margin_deg=float(min(np.abs(phase_margins), default=math.inf)),
        gain_margin_db=20 * math.log10(min(above_one)) if above_one else math.inf,
        peak_sensitivity=float(sensitivity[peak]),
        peak_sensitivity_hz=float(omega[peak]) / (2 * math.pi),
        attenuation={
            hz: float(abs(1 + response(np.array([2 * math.pi * hz]))[0])) for hz in compared_hz
        },
    )
