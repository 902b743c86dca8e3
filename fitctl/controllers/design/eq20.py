"""The paper's own compensator, Eq. 20, beside the paper's coarse integrator."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis, design_parameters
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

EQ20_GAIN = 18.3
EQ20_ZEROS = (25.0, 4.5, 0.5)
EQ20_ZERO_PAIRS = ((5.5, 37.2), (5.98, 39.5))
EQ20_POLES = (15.6, 4.4, 1.2, 0.44)
EQ20_POLE_PAIRS = ((5.9, 39.1), (3.8, 39.9))


def _roots(real: tuple[float, ...], pairs: tuple[tuple[float, float], ...]) -> Complexes:
    roots = [[-r for r in real], *(np.roots([1.0, *pair]) for pair in pairs)]
    return np.concatenate(roots, dtype=complex)


def eq20_zpk() -> tuple[Complexes, Complexes, float]:
    """Zeros, poles (rad/s) and gain of Eq. 20; its gain at rest is 26.75."""
    return _roots(EQ20_ZEROS, EQ20_ZERO_PAIRS), _roots(EQ20_POLES, EQ20_POLE_PAIRS), EQ20_GAIN


def design_eq20(basis: Basis) -> Design:
    """Eq. 20 by Tustin at the loop's rate, with the coarse loop's integrator on the same error."""
    return parallel_design("eq20", basis, *eq20_zpk(), design_parameters(basis))


def parallel_design(
    name: str,
    basis: Basis,
    zeros: Complexes,
    poles: Complexes,
    gain: float,
    parameters: dict[str, object],
) -> Design:
    """A pair of the parallel architecture: vernier compensator and coarse integrator on one error.

    Parameters
    ----------
    zeros, poles : arrays
        Of the continuous compensator, rad/s; by Tustin at the loop's rate.
    """
    a, b, c, d = tustin(tuple(zeros), tuple(poles), gain, basis.period_s)
    n = len(a)
    inputs = np.zeros((n, 5))
    inputs[:, 0] = inputs[:, 1] = b
    through = np.zeros((2, 5))
    through[0, 0] = through[0, 1] = -d
    through[1, 0] = -basis.coarse_per_s * basis.period_s
    return Design(
        name=name,
        period_s=basis.period_s,
        delay_s=basis.delay_s,
        a=a,
        b=inputs,
        c=np.vstack([-c, np.zeros(n)]),
        d=through,
        hysteresis_inverse=False,
        parameters=parameters,
    )


@functools.cache
def tustin(
    zeros: tuple[complex, ...], poles: tuple[complex, ...], gain: float, period_s: float
) -> tuple[Floats, Floats, Floats, float]:
    """A compensator by Tustin: A (n, n), B (n,), C (n,), D."""
    import control  # a second of import, and only designs need it

    continuous = control.ss(control.zpk(list(zeros), list(poles), gain))
    discrete = control.sample_system(continuous, period_s, method="bilinear")
    return (
        np.ascontiguousarray(discrete.A),
        np.ascontiguousarray(discrete.B[:, 0]),
        np.ascontiguousarray(discrete.C[0]),
        float(discrete.D[0, 0]),
    )
