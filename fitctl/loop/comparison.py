"""A learnt design at work, beside what the design before it would have left of the same frames.

Nights change, so what was measured before a change of designs says little about the design that was left.
The disturbance of each frame is rebuilt from where the stages were, and both designs follow it on paper.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.design.basis import Basis, basis, night_of, on_its_mirror
from fitctl.controllers.design.linear_loop.on_paper import SETTLE_S, OnPaper, TrueSquares
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.pair import Design
from fitctl.model.optics import AzEl, Scales, scales

Floats = NDArray[np.float64]
WATCHES = ((10.0, 1.06, math.inf), (30.0, 1.03, 1.1), (60.0, 0.99, math.inf))
"""Over a time constant in s, the learnt design may leave so much of the residual that the design before would
have left, both on paper, and so much on frames, where hysteresis and backlash add to it.

One that gains nothing for long is not worth what paper does not know: on random night 3615 it left 0 % more on
paper, and 3.6 % more on the plant.
"""
MOVES_LESS, AS_MUCH_LESS = 0.9, 0.95
"""With less than that part of the rig file's mirror gain, it may leave only so much of those limits on paper:
the hysteresis is then so unlike the rig file's that a design may leave 3 % less on paper, and 2 % more on the
plant, as on random night 6775."""
MOST_NOISE = 0.8
"""At most so much of what the design before would have left on frames counts as noise."""
_BEFORE = 1  # of what is measured, what the design before leaves, and what the learnt one leaves


class Comparison:
    """Two designs on one loop's frames.

    Parameters
    ----------
    scale : Scales
    learnt, before : Design
        The one at work, and the one before it.
    loop_basis : Basis
        The loop, with the mirror that the learnt design was made for, and the lines that it expects.
    noise_px : float
        One standard deviation of the noise on a frame, which both leave alike.

    Attributes
    ----------
    error_px, before_error_px : tuple of float
        What the learnt design leaves on the last frame, and the design before would have left, without what is
        near known aliases.
    """

    def __init__(
        self,
        scale: Scales,
        learnt: Design,
        before: Design,
        loop_basis: Basis,
        noise_px: float,
    ) -> None:
        self._noise_px2 = noise_px**2
        self._papers = OnPaper(before, loop_basis), OnPaper(learnt, loop_basis)
        # It goes on where both begin again: errors on frames have no jump there.
        self._true = TrueSquares(loop_basis.lines, loop_basis.period_s)
        self._scale = scale
        self._mirror_gain, self._overshoot = loop_basis.mirror_gain, loop_basis.overshoot
        self._of_limits = AS_MUCH_LESS if loop_basis.mirror_gain < MOVES_LESS else 1.0
        self._settle_frames = round(SETTLE_S / loop_basis.period_s)
        self._over_frames = np.array(
            [round(over_s / loop_basis.period_s) for over_s, *_ in WATCHES]
        )
        self.restart()

    def restart(self) -> None:
        """Frames are missing, or say nothing of the designs: begin again."""
        for paper in self._papers:
            paper.restart()
        self.error_px: AzEl = (0.0, 0.0)
        self.before_error_px: AzEl = (0.0, 0.0)
        self._frames = 0
        self._first_px: Floats | None = None
        self._mirror_px: Floats | None = None
        self._means_px2 = np.zeros((len(WATCHES), 3, 2))

    def observe(self, error_px: AzEl, mirror_rad: Floats, motor_rad: Floats) -> None:
        """One frame: the star's error, and mirror and motors as :meth:`.Learning.observe` has them."""
        mirror_px = np.asarray(self._scale.mirror_px(mirror_rad))
        last_px = mirror_px if self._mirror_px is None else self._mirror_px
        self._mirror_px = mirror_px
        mirror_px = self._mirror_gain * mirror_px + self._overshoot * (mirror_px - last_px)
        motor_px = self._scale.motor_px_per_rad * motor_rad.dot(self._scale.siderostat_turn.T)
        disturbance_px = np.array(error_px) - mirror_px - motor_px
        if self._first_px is None:
            self._first_px = disturbance_px
        disturbance_px = disturbance_px - self._first_px
        before, learnt = (paper.step(disturbance_px) for paper in self._papers)
        errors_px = np.array([error_px, before, learnt], dtype=float)
        squares, rest_px = self._true.step(disturbance_px, errors_px)
        self.error_px, self.before_error_px, _ = map(tuple, rest_px.tolist())
        self._frames += 1
        counted = self._frames - self._settle_frames
        if counted > 0:
            over = np.minimum(counted, self._over_frames)[:, None, None]
            self._means_px2 += (squares - self._means_px2) / over

    @property
    def before_px(self) -> float:
        """RMS that the design before would have left, worst axis; NaN until it has settled.

        On frames, and of known aliases in truth.
        """
        settled = self._frames > 2 * self._settle_frames
        return math.sqrt(self._means_px2[0, _BEFORE].max()) if settled else math.nan

    @property
    def why_back(self) -> str:
        """Why the design before is the better one; empty as long as it is not known to be."""
        counted = self._frames - self._settle_frames
        worst_axis_px2 = self._means_px2.max(axis=2).tolist()
        for means_px2, over, (over_s, most_on_paper, most_measured) in zip(
            worst_axis_px2, self._over_frames, WATCHES, strict=True
        ):
            if counted < over:
                break
            measured_px2, before_px2, learnt_px2 = means_px2
            noise_px2 = min(self._noise_px2, MOST_NOISE * before_px2)
            most_part = self._of_limits * most_on_paper
            if learnt_px2 - noise_px2 > most_part**2 * (before_px2 - noise_px2):
                left = f"would leave {math.sqrt(learnt_px2 - noise_px2):.4f} px besides the noise"
                return _better(left, over_s, before_px2 - noise_px2)
            if measured_px2 > most_measured**2 * before_px2:
                left = f"leaves {math.sqrt(measured_px2):.4f} px"
                return _better(left, over_s, before_px2)
        return ""


def _better(left: str, over_s: float, before_px2: float) -> str:
    return (
        f"the learnt design {left} over {over_s:g} s; the design before would have left "
        f"{math.sqrt(before_px2):.4f} of the same disturbance"
    )


def comparison(
    rig: Rig, loop_name: str, learnt: Design, before: Design, noise_px: float
) -> Comparison | None:
    """Of one loop; None if the design before is unstable on the mirror that the learnt one was made for."""
    own = basis(rig, loop_name)
    loop_basis = dataclasses.replace(
        on_its_mirror(own, learnt.parameters), lines=night_of(learnt, own).lines
    )
    if not sampled_loop(before, loop_basis).stable:
        return None
    scale = scales(rig, rig.stellar_loops[loop_name])
    return Comparison(scale, learnt, before, loop_basis, noise_px)
