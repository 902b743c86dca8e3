"""What a design would have left of a disturbance that was rebuilt from another design's frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
SETTLE_S = 5.0
"""A design that begins from rest knows air path and lines after so long."""


class OnPaper:
    """A design on stages that do exactly as commanded, frame by frame, both axes.

    Parameters
    ----------
    design : Design
    basis : Basis
        Of the loop: rate, delay, and the mirror's gain.
    """

    def __init__(self, design: Design, basis: Basis) -> None:
        loop = sampled_loop(design, basis)
        closed = loop.a + np.outer(loop.b, loop.star)
        self._system = np.block([[closed, loop.b[:, None]], [loop.star, 1.0]])
        self._given = np.zeros((len(self._system), 2))

    def restart(self) -> None:
        """Begin again from rest."""
        self._given[:] = 0.0

    def step(self, disturbance_px: Floats) -> Floats:
        """The error on a frame, shape (2,), for the star's own motion and the camera's noise on it.

        The disturbance counts from a place near the target, where the stages rest at first.
        """
        given = self._given
        given[-1] = disturbance_px
        made = self._system.dot(given)
        given[:-1] = made[:-1]
        return np.asarray(made[-1])


def left_on_paper(design: Design, basis: Basis, disturbance_px: Floats) -> Floats:
    """Mean square of the error on frames after `SETTLE_S`, by axis, px²; NaN for too few frames.

    Parameters
    ----------
    disturbance_px : array, shape (frames, 2)
        Without gaps.
    """
    paper = OnPaper(design, basis)
    errors_px = [paper.step(row) for row in disturbance_px - disturbance_px[0]]
    settled = errors_px[round(SETTLE_S / basis.period_s) :]
    return np.mean(np.square(settled), axis=0) if settled else np.full(2, np.nan)
