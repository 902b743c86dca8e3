"""Backlash of the siderostat's drive train: a play operator, and what it does to a sine.

The operator itself is :func:`fitctl.model.hysteresis.play`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Complexes = NDArray[np.complex128]


def describing_function(amplitude: ArrayLike, half_width: ArrayLike) -> Complexes:
    """Fundamental of a play's output over the sine that drives it.

    Parameters
    ----------
    amplitude, half_width : array_like
        Of the sine, and of the play, in one unit; their shapes broadcast. A play of half width h lets
        its input travel 2h, its total width, before the output follows back.

    Returns
    -------
    array, complex
        0 where the sine does not pass the half width, 1 far above it; its phase is a lag.

    Notes
    -----
    Gelb and Vander Velde, Multiple-Input Describing Functions and Nonlinear System Design (1968),
    appendix B, backlash.
    """
    amplitude, half_width = np.broadcast_arrays(
        np.asarray(amplitude, dtype=float), np.asarray(half_width, dtype=float)
    )
    passes = amplitude > half_width
    # What is left of the swing once the play is taken up: 0 at amplitude = half_width.
    follows = 1.0 - np.divide(half_width, amplitude, where=passes, out=np.ones_like(amplitude))
    sine = 2.0 * follows - 1.0
    in_phase = 0.5 + (np.arcsin(sine) + sine * np.sqrt(1.0 - sine**2)) / np.pi
    # The enclosed area, 4 h (A - h), gives the other part.
    quadrature = -4.0 * (1.0 - follows) * follows / np.pi
    return np.asarray(in_phase + 1j * quadrature)
