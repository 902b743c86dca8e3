"""The paper's vernier design: LQG with loop transfer recovery, Eq. 10-20."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fitctl.config import LqgLtr
from fitctl.controllers.design.basis import Basis, design_parameters
from fitctl.controllers.design.eq20 import eq20_zpk, parallel_design
from fitctl.controllers.design.linear_loop.loopshape import compensator_response
from fitctl.controllers.pair import Design
from fitctl.model.air_path import state_space

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Where compensators are compared, rad/s.
COMPARED_RAD_S: Floats = np.geomspace(0.01, 100.0, 2001)
_ROUNDING = 1e-9
_REMOVED = 2


@dataclass(frozen=True)
class NominalPlant:
    """Eq. 10-12: air path beside the shaping dynamics.

    Attributes
    ----------
    a : array, shape (6, 6)
    b_noise : array, shape (6, 2)
        B_w: of the air path's noise and of the pointing's.
    b : array, shape (6, 1)
        B of the mirror.
    c : array, shape (1, 6)
    shaping_zeros, shaping_poles : arrays
        Of Eq. 12, whose gain at rest is one; rad/s.
    """

    a: Floats
    b_noise: Floats
    b: Floats
    c: Floats
    shaping_zeros: Complexes
    shaping_poles: Complexes


class Compensator(NamedTuple):
    """The vernier compensator as Eq. 20 prints it.

    Attributes
    ----------
    zeros, poles : arrays, complex, rad/s
    gain : float
        Of the highest powers of s.
    removed_poles : array, complex, rad/s
        The fast ones that the recovery left and the reduction dropped.
    """

    zeros: Complexes
    poles: Complexes
    gain: float
    removed_poles: Complexes


class Recovery(NamedTuple):
    """How near the recovered loop comes to the target loop, over `COMPARED_RAD_S`."""

    control_weight: float
    distance_db: float
    distance_deg: float
    fastest_pole_rad_s: float


def nominal_plant(basis: Basis) -> NominalPlant:
    """Eq. 10-12 for a loop."""
    import control

    settings = basis.settings.lqg_ltr
    air_a, air_b, air_c = state_space(basis.air_path)
    n, notch = settings.omega_n_rad_s, settings.omega_notch_rad_s
    numerator = np.array([1.0, 2 * settings.zeta_zero * notch, notch**2])
    slow = [1.0, 2 * settings.zeta * n, n**2]
    denominator = np.polymul(slow, [1.0, 2 * settings.zeta_pole * notch, notch**2])
    shaping = control.ss(control.tf(n**2 * numerator, denominator))
    return NominalPlant(
        a=block_diag(air_a, shaping.A),
        b_noise=block_diag(air_b, shaping.B),
        b=np.vstack([np.zeros((len(air_a), 1)), shaping.B]),
        c=np.hstack([air_c, shaping.C]),
        shaping_zeros=np.roots(numerator).astype(complex),
        shaping_poles=np.roots(denominator).astype(complex),
    )


def kalman_gain(plant: NominalPlant, settings: LqgLtr) -> Floats:
    """F of Eq. 13-15, shape (6, 1)."""
    import control

    gain, *_ = control.lqe(
        plant.a,
        plant.b_noise,
        plant.c,
        np.diag(settings.process_noise),
        np.array([[settings.measurement_noise]]),
    )
    return np.asarray(gain)


def target_loop(plant: NominalPlant, kalman: Floats, omega_rad_s: Floats) -> Complexes:
    """G_TFL of Eq. 13 at some frequencies."""
    s = 1j * omega_rad_s[:, None, None]
    return np.asarray(
        (plant.c @ np.linalg.solve(s * np.eye(len(plant.a)) - plant.a, kalman))[:, 0, 0]
    )


def recovered(plant: NominalPlant, kalman: Floats, control_weight: float) -> Compensator:
    """C_LQG(s) G(s) of Eq. 17-19, nothing removed."""
    import control

    regulator, *_ = control.lqr(plant.a, plant.b, plant.c.T @ plant.c, [[control_weight]])
    a = plant.a - kalman @ plant.c - plant.b @ regulator
    lqg = control.ss(a, kalman, regulator, 0.0)
    lqg_poles, lqg_zeros = in_pairs(control.poles(lqg)), in_pairs(control.zeros(lqg))
    # The nominal plant is the shaping alone: the mirror does not move the air path.
    zeros = np.concatenate([lqg_zeros, plant.shaping_zeros])
    poles = np.concatenate([lqg_poles, plant.shaping_poles])
    # The gain of the highest powers: K F for the LQG compensator, and the shaping's own.
    shaping_gain = float(np.real(np.prod(plant.shaping_poles) / np.prod(plant.shaping_zeros)))
    return Compensator(
        zeros, poles, float((regulator @ kalman)[0, 0]) * shaping_gain, np.empty(0, complex)
    )


def in_pairs(roots: Complexes) -> Complexes:
    """Roots of a real polynomial with complex ones exactly in pairs; rounding may leave them apart.

    Raises
    ------
    ArithmeticError
        If they are farther apart than that.
    """
    real = np.abs(roots.imag) <= _ROUNDING * np.abs(roots)
    upper, lower = roots[~real & (roots.imag > 0)], roots[~real & (roots.imag < 0)]
    apart = (
        np.sort_complex(upper) - np.sort_complex(lower.conj()) if len(upper) == len(lower) else 1
    )
    if np.any(np.abs(apart) > _ROUNDING * np.abs(roots).max(initial=1.0)):
        msg = "roots of a real polynomial do not come in pairs"
        raise ArithmeticError(msg)
    return np.concatenate([roots[real].real, upper, upper.conj()]).astype(complex)


def without_fast_poles(compensator: Compensator) -> Compensator:
    """The fastest poles dropped, the gain at rest kept.

    Raises
    ------
    ArithmeticError
        If that would part a pair of complex poles.
    """
    order = np.argsort(np.abs(compensator.poles))
    kept, removed = compensator.poles[order[:-_REMOVED]], compensator.poles[order[-_REMOVED:]]
    if abs(removed.imag.sum()) > _ROUNDING * np.abs(removed).max():
        msg = f"dropping the {_REMOVED} fastest poles of the compensator would part a pair of complex ones"
        raise ArithmeticError(msg)
    gain = compensator.gain / float(np.real(np.prod(-removed)))
    return Compensator(compensator.zeros, kept, gain, removed)


def vernier_compensator(basis: Basis) -> Compensator:
    """C_FSM of Eq. 20, for a loop's own air path and settings."""
    settings = basis.settings.lqg_ltr
    plant = nominal_plant(basis)
    return without_fast_poles(
        recovered(plant, kalman_gain(plant, settings), settings.control_weight)
    )


def recovery(basis: Basis, control_weights: Sequence[float]) -> list[Recovery]:
    """Distance of the recovered loop from the target loop as R falls."""
    plant = nominal_plant(basis)
    kalman = kalman_gain(plant, basis.settings.lqg_ltr)
    target = target_loop(plant, kalman, COMPARED_RAD_S)
    steps = []
    for weight in control_weights:
        found = recovered(plant, kalman, weight)
        response = compensator_response(found.zeros, found.poles, found.gain)(COMPARED_RAD_S)
        distance = distance_db_deg(response, target)
        steps.append(Recovery(weight, *distance, float(np.abs(found.poles).max())))
    return steps


def distance_db_deg(response: Complexes, reference: Complexes) -> tuple[float, float]:
    """Largest distance of one response from another, in dB and in degrees."""
    ratio = response / reference
    return (
        float(np.abs(20 * np.log10(np.abs(ratio))).max()),
        float(np.abs(np.degrees(np.angle(ratio))).max()),
    )


def distance_from_eq20(compensator: Compensator) -> tuple[float, float]:
    """Largest distance from the printed Eq. 20 over 0.01-100 rad/s, in dB and in degrees."""
    response = compensator_response(compensator.zeros, compensator.poles, compensator.gain)
    return distance_db_deg(
        response(COMPARED_RAD_S), compensator_response(*eq20_zpk())(COMPARED_RAD_S)
    )


def design_lqg_ltr(basis: Basis) -> Design:
    """The vernier by Eq. 10-20 and Tustin, beside the coarse loop's integrator."""
    compensator = vernier_compensator(basis)
    return parallel_design(
        "lqg-ltr",
        basis,
        compensator.zeros,
        compensator.poles,
        compensator.gain,
        parameters=design_parameters(basis, "lqg_ltr"),
    )
