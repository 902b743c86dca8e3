"""What a design would have left of a disturbance that was rebuilt from another design's frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis, Line
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.design.linear_loop.spectrum import seen_at_hz
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]
SETTLE_S = 5.0
"""A design that begins from rest knows air path and lines after so long."""
_NARROWEST_HZ, _SLOWEST_HZ = 0.6, 0.1
_HALF_WIDTHS = 4.0
_BROADEST = 0.25  # of the frame rate: what is broader would be unstable near half of it


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
        self._system = np.block([[closed, loop.b[:, None]], [loop.star[None], np.ones((1, 1))]])
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


class TrueSquares:
    """Squares of errors on frames, as they are between frames, too, where lines are known to be aliases.

    On frames such a line is slow, and a design that counteracts it seems to leave little. In truth the mirror's
    motion is added to it, at another frequency. So of what frames show near it, the star's motion and the
    mirror's count each for itself.

    Parameters
    ----------
    lines : sequence of Line
        Where they are. Those up to half the frame rate are no aliases.
    period_s : float
        Of frames.
    """

    def __init__(self, lines: Sequence[Line], period_s: float) -> None:
        self._notches = [
            _Notch(line, period_s) for line in lines if line.frequency_hz > 0.5 / period_s
        ]

    def step(self, disturbance_px: Floats, errors_px: Floats) -> tuple[Floats, Floats]:
        """Of one frame, px², and the errors without what is near aliases, px, shape (n, 2) each.

        Parameters
        ----------
        disturbance_px : array, shape (2,)
            The star's motion.
        errors_px : array, shape (n, 2)
            What mirrors left of it.
        """
        if not self._notches:
            return np.square(errors_px), errors_px
        motions_px = np.vstack([disturbance_px, errors_px - disturbance_px])
        rest_px = motions_px
        for notch in self._notches:
            rest_px = notch.step(rest_px)
        star_px2, *mirrors_px2 = np.square(motions_px - rest_px)
        without_px = rest_px[0] + rest_px[1:]
        return np.square(without_px) + star_px2 + mirrors_px2, without_px


class _Notch:
    """Removes the frequencies near which frames show a line."""

    def __init__(self, line: Line, period_s: float) -> None:
        rate_hz, half_width_hz = 1 / period_s, line.damping * line.frequency_hz
        seen_hz = seen_at_hz(line.frequency_hz, rate_hz)
        seen_hz = min(max(_SLOWEST_HZ, seen_hz), rate_hz / 2 - _SLOWEST_HZ)
        width_hz = max(_NARROWEST_HZ, _HALF_WIDTHS * half_width_hz)
        width_hz = min(width_hz, _BROADEST * rate_hz)
        # As `scipy.signal.iirnotch` has it, 3 dB at the edges; a supervisor imports no scipy.
        cosine = math.cos(2 * math.pi * seen_hz / rate_hz)
        gain = 1 / (1 + math.tan(math.pi * width_hz / rate_hz))
        self._b = gain, -2 * gain * cosine, gain
        self._a = 1.0, -2 * gain * cosine, 2 * gain - 1
        self._first, self._second = np.zeros(()), np.zeros(())

    def step(self, given: Floats) -> Floats:
        """The next of a sequence, of any shape."""
        b, a = self._b, self._a
        left = b[0] * given + self._first
        self._first = b[1] * given - a[1] * left + self._second
        self._second = b[2] * given - a[2] * left
        return left


def left_on_paper(design: Design, basis: Basis, disturbance_px: Floats) -> Floats:
    """Mean square of the error after `SETTLE_S`, by axis, px²; NaN for too few frames.

    On frames; of lines of the basis that are aliases, in truth: see :class:`TrueSquares`.

    Parameters
    ----------
    disturbance_px : array, shape (frames, 2)
        Without gaps.
    """
    paper, true = OnPaper(design, basis), TrueSquares(basis.lines, basis.period_s)
    squares_px2 = [
        true.step(row, paper.step(row)[None])[0][0] for row in disturbance_px - disturbance_px[0]
    ]
    settled = squares_px2[round(SETTLE_S / basis.period_s) :]
    return np.mean(settled, axis=0) if settled else np.full(2, np.nan)
